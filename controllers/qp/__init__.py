"""The QP of one sample, what its solution is worth, and the backends that solve it."""
