"""Times of plant, controllers, learning, export and evaluation, beside references of the same run.

Not part of the wheel: `python -m benchmarks NAME` runs one in a checkout.
"""
