"""Handlers that pyserial finds by name for ``sim://`` URLs; the ports themselves are in `sim.port`."""
