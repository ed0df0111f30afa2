"""NMPC as function approximator: parametric OCP, one QP per sample, its sensitivities."""
