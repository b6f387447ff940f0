"""Side-by-side measurements, each a module to be run: `python -m benchmarks.contact`."""
