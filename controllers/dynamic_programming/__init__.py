"""Dynamic programming on a state grid: quadrature, interpolation, policy iteration."""
