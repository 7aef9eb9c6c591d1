"""Rewrite the data files next to this script: python datasets/regenerate.py

The files follow from seeds, so that running this leaves them as they
are, byte for byte.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from lpvlearn.datasets.reference import spring_structure, write_reference

SAMPLING_TIME = 0.02
STIFFNESS = {0.0: 40.0, 0.5: 45.0, 1.0: 60.0, 1.5: 85.0}  # 40 + 20 kappa^2


def spring_table(seed: int = 0) -> pd.DataFrame:
    """Four experiments on a mass whose spring stiffens with kappa, with noise."""
    spring = spring_structure()
    rng = np.random.default_rng(seed)
    runs = []
    for number, (kappa, stiffness) in enumerate(STIFFNESS.items()):
        force = rng.choice([-1.0, 1.0], 200).repeat(3)
        model = spring.model({"k": stiffness, "c": 1.2, "b": 30.0})
        position = model.simulate(force, sampling_time=SAMPLING_TIME)[:, 0]
        position += 0.01 * rng.normal(size=len(force))
        runs.append(
            pd.DataFrame(
                {
                    "run": f"run {number + 1}",
                    "time": SAMPLING_TIME * np.arange(len(force)),
                    "kappa": kappa,
                    "force": force,
                    "position": position,
                }
            )
        )
    return pd.concat(runs, ignore_index=True).round(5)


GRAVITY, DAMPING = 9.81, 0.15  # m/s2, 1/s


def swing(acceleration: np.ndarray, rope: np.ndarray, step: float) -> np.ndarray:
    """Angle (rad) of a load on a rope of varying length (m) below a trolley (m/s2)."""
    hoisting = np.gradient(rope, step)
    angle, rate, found = 0.0, 0.0, []
    for a, length, speed in zip(acceleration, rope, hoisting, strict=True):
        found.append(angle)
        for _ in range(10):
            torque = GRAVITY * np.sin(angle) + a * np.cos(angle) + 2 * speed * rate
            rate += step / 10 * (-torque / length - DAMPING * rate)
            angle += step / 10 * rate
    return np.array(found)


def crane_tables(seed: int = 0) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Five experiments on a gantry crane, each at one rope length; a hoisting."""
    rng, step, n = np.random.default_rng(seed), 0.05, 800

    def record(run: str, rope: np.ndarray) -> pd.DataFrame:
        acceleration = 0.3 * np.repeat(rng.choice([-1.0, 1.0], n // 5 + 1), 5)[:n]
        angle = swing(acceleration, rope, step)
        columns = {
            "run": run,
            "time": step * np.arange(n),
            "acceleration": acceleration,
            "rope": rope,
            "angle": angle + 0.002 * rng.standard_normal(n),
        }
        return pd.DataFrame(columns).round(6)

    runs = [
        record(f"run {k}", np.full(n, length))
        for k, length in enumerate([1.0, 1.5, 2.0, 2.5, 3.0])
    ]
    hoisting = record("hoisting", np.linspace(3.0, 1.0, n))
    return pd.concat(runs, ignore_index=True), hoisting


if __name__ == "__main__":
    folder = Path(__file__).resolve().parent
    write_reference(folder)
    spring_table().to_csv(folder / "varying_spring.csv", index=False)
    crane, hoisting = crane_tables()
    crane.to_csv(folder / "gantry_crane.csv", index=False)
    hoisting.to_csv(folder / "gantry_crane_hoisting.csv", index=False)
