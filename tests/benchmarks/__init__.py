"""Run time against error: ``python -m tests.benchmarks``. Nothing here is a test, and no test depends on a time."""
