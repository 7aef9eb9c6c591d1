"""The seeded reference set that ships with the library."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from sklearn.utils import Bunch

from ..structures.structure import GrayBoxStructure
from .flexible_arm import FlexibleArm
from .generator import INPUTS, OUTPUTS, describe_arm, make_flexible_arm

REFERENCE_SEED = 0

_SAMPLING_TIME = 1e-3  # s

_INTEGRATION_STEP = 1e-3  # s: exact to the rounding of the stored files

_N_OPERATING_POINTS = 7  # as the paper

TABLES = {
    "flexible_arm_estimation.csv.gz": ("X", "y"),
    "flexible_arm_local_validation.csv.gz": ("X_local", "y_local"),
    "flexible_arm_sweep.csv.gz": ("X_sweep", "y_sweep"),
    "flexible_arm_sweep_down.csv.gz": ("X_sweep_down", "y_sweep_down"),
}

# Seven significant digits resolve y to 1e-4 of its noise.
FLOAT_FORMAT = "%.7g"


def data_folder() -> Path:
    """Folder of the data files that ship with the library.

    Returns
    -------
    Path

    Raises
    ------
    FileNotFoundError
        If they are neither in the package nor, as in an editable install, beside it.

    Examples
    --------
    >>> import pandas as pd
    >>> from lpvlearn.datasets import data_folder
    >>> pd.read_csv(data_folder() / "gantry_crane.csv", nrows=1)
         run  time  acceleration  rope     angle
    0  run 0   0.0           0.3   1.0  0.004005
    """
    here = Path(__file__).resolve().parent
    candidates = [here / "data", here.parents[1] / "datasets"]
    for folder in candidates:
        if (folder / next(iter(TABLES))).is_file():
            return folder
    raise FileNotFoundError(
        "The data files of `load_flexible_arm` must lie in one of "
        f"{[str(folder) for folder in candidates]}; reinstall lpvlearn, or generate "
        "the same data with `make_flexible_arm(random_state=0)`."
    )


def load_flexible_arm() -> Bunch:
    """Load the seeded reference experiments on the flexible arm.

    One realization at 30 dB of ``make_flexible_arm(random_state=0)``, stored in the
    text files of the folder ``datasets`` to 7 significant digits.

    Returns
    -------
    data : Bunch
        The same entries as `make_flexible_arm`; `DESCR` is the data card.

    Examples
    --------
    >>> from lpvlearn.datasets import load_flexible_arm
    >>> data = load_flexible_arm()
    >>> data.X.shape, data.y.shape
    ((21000, 5), (21000, 2))
    >>> data.X["experiment"].nunique()
    7
    """
    folder = data_folder()
    parts: dict[str, pd.DataFrame] = {}
    for name, (inputs, outputs) in TABLES.items():
        table = pd.read_csv(folder / name)
        parts[inputs] = table[[*INPUTS, "kappa", "experiment", "time"]]
        parts[outputs] = table[OUTPUTS]
    theta2 = np.pi * np.arange(1, _N_OPERATING_POINTS + 1) / (_N_OPERATING_POINTS + 1)
    return Bunch(
        **parts,
        **describe_arm(FlexibleArm(), theta2, _SAMPLING_TIME),
        DESCR=(folder / "README.md").read_text(encoding="utf-8"),
    )


def spring_structure() -> GrayBoxStructure:
    """A mass on a spring with damping, driven by a force: parameters b, c, k."""
    return GrayBoxStructure.from_template(
        A=[[0, 1], ["-k", "-c"]], B=[[0], ["b"]], C=[[1, 0]]
    )


def load_varying_spring() -> Bunch:
    """Load four local experiments on a mass whose spring stiffens with `kappa`.

    The smallest LPV system: one input, one output, one scheduling variable; the table
    of the README.

    Returns
    -------
    data : Bunch
        X : DataFrame
            Columns `run`, `time` (s), `kappa` (scheduling) and `force` (input); 4 runs
            of 600 samples.
        y : DataFrame
            Column `position`.
        structure : GrayBoxStructure
            ``position'' = -k position - c position' + b force``.
        sampling_time : float
            0.02 s.
        true_parameters : DataFrame
            b, c and k at the four values of `kappa`.
        DESCR : str
            The data card.

    Examples
    --------
    >>> from lpvlearn.datasets import load_varying_spring
    >>> data = load_varying_spring()
    >>> data.X.shape, list(data.X)
    ((2400, 4), ['run', 'time', 'kappa', 'force'])
    >>> data.true_parameters
              b    c     k
    kappa
    0.0    30.0  1.2  40.0
    0.5    30.0  1.2  45.0
    1.0    30.0  1.2  60.0
    1.5    30.0  1.2  85.0
    """
    folder = data_folder()
    table = pd.read_csv(folder / "varying_spring.csv")
    kappa = pd.Index(table["kappa"].unique(), name="kappa")
    return Bunch(
        X=table.drop(columns="position"),
        y=table[["position"]],
        structure=spring_structure(),
        sampling_time=0.02,
        true_parameters=pd.DataFrame(
            {"b": 30.0, "c": 1.2, "k": 40.0 + 20.0 * kappa.to_numpy() ** 2}, kappa
        ),
        DESCR=(folder / "README.md").read_text(encoding="utf-8"),
    )


def write_reference(folder: Path) -> None:
    """Write the reference files into `folder`, always the same bytes."""
    data = make_flexible_arm(
        n_operating_points=_N_OPERATING_POINTS,
        sampling_time=_SAMPLING_TIME,
        random_state=REFERENCE_SEED,
        integration_step=_INTEGRATION_STEP,
    )
    for name, (inputs, outputs) in TABLES.items():
        # Adding zero turns -0 into 0; the time of writing would change the bytes.
        (data[inputs].join(data[outputs]) + 0).to_csv(
            folder / name,
            index=False,
            float_format=FLOAT_FORMAT,
            lineterminator="\n",
            compression={"method": "gzip", "compresslevel": 9, "mtime": 0},
        )
