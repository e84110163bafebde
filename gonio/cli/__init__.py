"""The ``gonio`` command: one file per verb, imported when it is called. It alone prints."""
