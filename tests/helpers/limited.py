"""The evaporator's model with a limit: it is not finite where P2 passes 50 kPa.

An NMPC linearises it at the guess. Where the last solution predicts more than 50 kPa its next solve
fails; from the reference, 49.7 kPa, it succeeds again.
"""

from dataclasses import replace

import casadi as ca

from controllers import evaporator
from controllers.model import Model

LIMIT = 50.0


def model() -> Model:
    known = evaporator.model()

    def ode(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
        return known.ode(x, u, w, p) + 1e-12 * ca.log(LIMIT - x[1])

    return replace(known, name="limited", ode=ode)
