"""Changes of costs and values by moving prices alone, independent of the controller.

A price's change by the hour moves the cost of every sample, and at N samples ahead that of the
predicted ones: a learning rule would take this for an error of V. At the reference it is known.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from controllers.functions import StackedFunction, define
from controllers.problem import Problem, of_kind
from cosim.core.protocols import Array
from cosim.core.signals import Known


class SignalCosts:
    """Change of the economic cost at the reference by known prices.

    Args:
        problem: Has the prices among its varying quantities, or none.
    """

    def __init__(self, problem: Problem) -> None:
        model = problem.model
        self._prices = [item for _, item in of_kind(problem.varying, "price")]
        self._discounts = problem.discounts[:-1].tolist()
        prices = ca.SX.sym("prices", len(self._prices))
        parameters = ca.SX(ca.DM(model.nominal_parameters))
        for row, item in enumerate(self._prices):
            parameters[item.place] = prices[row]
        still = ca.SX(ca.DM(model.nominal_parameters))
        x = ca.SX(ca.DM(problem.reference_state))
        u = ca.SX(ca.DM(problem.reference_action))
        d = ca.SX(ca.DM(model.nominal_disturbance))
        cost_at_prices = model.economic_cost(x, u, d, parameters)
        cost_at_nominal_prices = model.economic_cost(x, u, d, still)
        change = cost_at_prices - cost_at_nominal_prices
        definition = define("change", {"prices": prices}, {"change": change})
        self._change = StackedFunction(definition)
        self._changes: dict[tuple[float, ...], float] = {}

    def of_sample(self, known: Known) -> tuple[float, float]:
        """The change of the stage cost of a sample, and that of V: of all stages of its QP.

        Args:
            known: What is known at the sample, by the signals' names.
        """
        if not self._prices:
            return 0.0, 0.0
        columns = [known[item.signal].tolist() for item in self._prices]
        stages = []
        for k in range(len(self._discounts)):
            # Beyond the last known value the NMPC holds it.
            prices = tuple(column[min(k, len(column) - 1)] for column in columns)
            stages.append(self._change_at(prices))
        value = sum(d * change for d, change in zip(self._discounts, stages, strict=True))
        return stages[0], value

    def along(self, prices: Array) -> Array:
        """The change of the stage cost of K samples, (K,).

        Args:
            prices: at these samples, in the order of the problem's, (K, n_prices).
        """
        changes = [self._change_at(tuple(row)) for row in prices.tolist()]
        return np.array(changes, dtype=np.float64)

    def _change_at(self, prices: tuple[float, ...]) -> float:
        """The change of a stage's cost at some prices."""
        if not prices:
            return 0.0
        if prices not in self._changes:
            self._change.inputs["prices"][:] = prices
            self._change()
            self._changes[prices] = float(self._change.stack[0])
        return self._changes[prices]
