"""The evaporator as printed in paper.tex, Simulations: what the FMU and the model are held to."""

import numpy as np

NUMBERS = {
    "a": 0.5616, "b": 0.3126, "c": 48.43, "d": 0.507, "e": 55.0, "f": 0.1538, "g": 90.0, "h": 0.16,
    "M": 20.0, "C": 4.0, "UA2": 6.84, "Cp": 0.07, "lambda_": 38.5, "lambda_s": 36.6, "F3": 50.0,
}  # fmt: skip
"""The parameters by the FMU's names."""
ALGEBRAIC = ("F2", "F4", "F5", "F100", "T2", "T3", "T100", "UA1", "Q100", "Q200", "economic_cost")


def evaporator(x, u, d, /, **changes):
    """Every output by its name, and the `rates` of X2 and P2 per minute, solved by hand."""
    (x2, p2), (p100, f200), (x1, f1, t1, t200), p = x, u, d, NUMBERS | changes
    t2, t3, t100 = p["a"] * p2 + p["b"] * x2 + p["c"], p["d"] * p2 + p["e"], p["f"] * p100 + p["g"]
    ua1 = p["h"] * (f1 + p["F3"])
    q100 = ua1 * (t100 - t2)
    f4 = (q100 - f1 * p["Cp"] * (t2 - t1)) / p["lambda_"]
    q200 = p["UA2"] * (t3 - t200) / (1 + p["UA2"] / (2 * p["Cp"] * f200))
    f2, f5, f100 = f1 - f4, q200 / p["lambda_"], q100 / p["lambda_s"]
    cost = 10.09 * (f2 + p["F3"]) + 600 * f100 + 0.6 * f200
    rates = np.array([(f1 * x1 - f2 * x2) / p["M"], (f4 - f5) / p["C"]])
    values = (f2, f4, f5, f100, t2, t3, t100, ua1, q100, q200, cost)
    return dict(zip(ALGEBRAIC, values, strict=True)) | {"rates": rates}
