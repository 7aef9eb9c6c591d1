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


if __name__ == "__main__":
    folder = Path(__file__).resolve().parent
    write_reference(folder)
    spring_table().to_csv(folder / "varying_spring.csv", index=False)
