"""The `cosim` command line: it composes plants, controllers, learning and records."""
