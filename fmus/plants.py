"""The benchmark's other plants as FMUs: an exothermic reactor, four tanks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from fmus.model import Model
from fmus.plant import Signal, build_plant, plant_model

PACKAGE = Path(__file__).parent


def reactor() -> Model:
    """An exothermic stirred-tank reactor with disturbed feed."""
    return plant_model(
        "reactor",
        description="Exothermic stirred-tank reactor with disturbed feed",
        states=[
            Signal("cA", "mol/L", 0.5, 0.0, 10.0, "concentration of A"),
            Signal("T", "K", 345.0, 200.0, 600.0, "temperature"),
        ],
        inputs=[
            Signal("q", "L/min", 100.0, 0.0, 500.0, "feed flow"),
            Signal("Tc", "K", 320.0, 200.0, 400.0, "temperature of the jacket"),
        ],
        disturbances=[
            Signal("cAf", "mol/L", 1.0, 0.0, 10.0, "concentration of A in the feed", 0.1),
            Signal("Tf", "K", 350.0, 200.0, 500.0, "temperature of the feed", 5.0),
        ],
        outputs=[Signal("cost", "1", 30.0, -1e4, 1e4, "cost of feed and cooling less product")],
        parameters=[
            Signal("V", "L", 100.0, 1.0, 1e4, "volume"),
            Signal("k0", "1/min", 9.2e4, 0.0, 1e14, "rate constant at infinite temperature"),
            Signal("E", "K", 4000.0, 0.0, 1e5, "activation energy over the gas constant"),
            Signal("heat", "K.L/mol", 120.0, 0.0, 1e4, "temperature rise by 1 mol/L of reaction"),
            Signal("UA", "1/min", 2.09, 0.0, 100.0, "jacket's heat transfer over heat capacity"),
            Signal("feed_price", "1", 0.1, 0.0, 10.0, "price of the feed over the product's"),
            Signal("pump_price", "1", 0.004, 0.0, 10.0, "price of the squared flow"),
            Signal("cooling_price", "1", 0.01, 0.0, 10.0, "price of the squared cooling"),
            Signal("fixed_cost", "1", 50.0, 0.0, 1e3, "cost of the plant as such"),
        ],
        sampling_time=12.0,
    )


def tanks() -> Model:
    """The quadruple tank of Johansson (2000), with water drawn at random from the lower tanks."""
    return plant_model(
        "tanks",
        description="Quadruple tank with water drawn at random from the lower tanks",
        states=[
            Signal(f"h{i}", "cm", start, 0.0, 50.0, f"level of tank {i}")
            for i, start in ((1, 10.0), (2, 10.0), (3, 2.0), (4, 2.0))
        ],
        inputs=[Signal(f"v{i}", "V", 3.0, 0.0, 10.0, f"voltage of pump {i}") for i in (1, 2)],
        disturbances=[
            Signal(f"d{i}", "cm3/s", 3.0, -20.0, 20.0, f"water drawn from tank {i}", 3.0)
            for i in (1, 2)
        ],
        outputs=[Signal("cost", "V2", 20.0, 0.0, 200.0, "pumping v1² + v2²")],
        parameters=[
            *(Signal(f"A{i}", "cm2", 28.0 if i % 2 else 32.0, 1.0, 1e3, f"area of tank {i}")
              for i in (1, 2, 3, 4)),
            *(Signal(f"a{i}", "cm2", 0.071 if i % 2 else 0.057, 1e-3, 1.0, f"hole of tank {i}")
              for i in (1, 2, 3, 4)),
            Signal("k1", "cm3/(V.s)", 3.33, 0.0, 20.0, "pump 1's flow"),
            Signal("k2", "cm3/(V.s)", 3.35, 0.0, 20.0, "pump 2's flow"),
            Signal("split1", "1", 0.70, 0.0, 1.0, "share of pump 1 into the lower tank"),
            Signal("split2", "1", 0.60, 0.0, 1.0, "share of pump 2 into the lower tank"),
        ],
        sampling_time=5.0,
    )  # fmt: skip


PLANTS: dict[str, Callable[[], Model]] = {"reactor": reactor, "tanks": tanks}


def equations(name: str) -> bytes:
    """The C header with a plant's right-hand side."""
    return (PACKAGE / "equations" / f"{name}.h").read_bytes()


def build(folder: Path, every_platform: bool = False) -> list[Path]:
    """Build both FMUs (FMI 2.0) into `folder` and return their paths."""
    return [
        build_plant(model(), equations(name), folder / f"{name}.fmu", 2, every_platform)
        for name, model in PLANTS.items()
    ]
