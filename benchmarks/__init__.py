"""Times of plant, controllers, learning, export and evaluation, beside references of the same run.

Not part of the wheel: `cosim benchmark NAME` runs `python -m benchmarks NAME` in a checkout.
"""
