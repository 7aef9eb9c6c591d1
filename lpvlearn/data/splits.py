"""Splits of tables of experiments that respect time.

A dynamic model needs the samples of an experiment complete and in order, so that rows
cannot be dealt out like cards. `ExperimentSplit` holds out whole experiments or whole
operating points, `BlockedTimeSeriesSplit` the later part of every experiment.

Examples
--------
Two experiments at each of four operating points of a spring that stiffens:

>>> import numpy as np
>>> from sklearn.model_selection import GridSearchCV, cross_val_score
>>> from lpvlearn import ExperimentSplit, GrayBoxRestructurer, GrayBoxStructure
>>> from lpvlearn import LocalLPVPipeline, SubspaceLTI, bft_scorer, from_trajectories
>>> from lpvlearn import PolynomialLPV, make_bft_scorer
>>> spring = GrayBoxStructure.from_template(
...     A=[[0, 1], ["-k", "-c"]], B=[[0], [1]], C=[[1, 0]])
>>> rng = np.random.default_rng(0)
>>> trajectories = []
>>> for kappa in np.repeat([0.0, 1.0, 2.0, 3.0], 2):
...     model = spring.model({"k": 4 + kappa**2, "c": 1})
...     u = np.sign(rng.standard_normal(100))
...     y = model.simulate(u, sampling_time=0.1)
...     trajectories.append((u, kappa, y + 0.002 * rng.standard_normal(y.shape)))
>>> X, y = from_trajectories(trajectories, sampling_time=0.1)
>>> roles = {"scheduling": "kappa", "experiment": "experiment"}
>>> pipeline = LocalLPVPipeline(
...     SubspaceLTI(order=2, horizon=10, feedthrough=False),
...     GrayBoxRestructurer(spring, norm="similarity"), PolynomialLPV(),
...     time="time", **roles)

How well a new experiment is simulated:

>>> cv = ExperimentSplit(2, **roles)
>>> scores = cross_val_score(pipeline, X, y, cv=cv, scoring=bft_scorer)
>>> bool((scores > 90).all())
True

The degree, from models that lack one operating point each, scored over the whole range.
With ``memory=`` of the pipeline, nothing is identified twice:

>>> cv = ExperimentSplit("all", hold_out="operating_point", interior=True,
...                      test_on="all", **roles)
>>> search = GridSearchCV(
...     pipeline, {"interpolator__degree": [1, 2]}, cv=cv, refit=False,
...     scoring=make_bft_scorer(average="experiment"))
>>> search.fit(X, y).best_params_
{'interpolator__degree': 2}
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from itertools import compress
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import nnls
from sklearn.model_selection import BaseCrossValidator
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_consistent_length, column_or_1d

from ..exceptions import VersionedPickle
from ..validation import flag, naming_argument, one_of, whole_number
from .experiments import Experiment, group_rows, operating_point_of, roles_of
from .operating_points import group_operating_points
from .tables import Column, Table

__all__ = ["BlockedTimeSeriesSplit", "ExperimentSplit"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_BESIDE = 1e-3  # of the ranges: what is so near the others is within them

# Rows of the experiments to train on, and of those to test on.
Parts = tuple[list[Indices], list[Indices]]


class _SplitOfExperiments(VersionedPickle, BaseCrossValidator):
    """Splits of which training and test set are put together from experiments.

    Subclasses say what their experiments are (`_read`), how many folds these make
    (`_count`), and which rows of which experiments every fold takes (`_parts`).
    """

    n_splits: int | str

    __metadata_request__split = {"groups": True}  # where scikit-learn routes metadata

    def get_n_splits(self, X: Any = None, y: Any = None, groups: Any = None) -> int:
        """Number of folds.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
            Needed only where their number depends on it (``n_splits="all"``).
        y : object
            Ignored.
        groups : array-like of shape (n_samples,), optional
            As in `split`.

        Returns
        -------
        int
        """
        return self._count(X, groups)

    def split(
        self, X: Any, y: Any = None, groups: Any = None
    ) -> Iterator[tuple[Indices, Indices]]:
        """Yield the rows of every training and test set.

        Parameters
        ----------
        X : DataFrame or array-like of shape (n_samples, n_features)
        y : object
            Ignored.
        groups : array-like of shape (n_samples,), optional
            Labels of the experiments, without the `experiment` column.

        Yields
        ------
        train, test : ndarray of int

        Raises
        ------
        ValueError
            When there are fewer experiments (points) than folds, an experiment is too
            short for the folds and the gap, or a column is missing.
        """
        for train, test in self._parts(self._read(X, groups)):
            yield np.concatenate(train), np.concatenate(test)

    def _read(self, X: Any, groups: Any) -> list[Experiment]:
        """Rows of the experiments, and what tells their operating points.

        `groups` are labels of the experiments where no column has them.
        """
        table, roles = Table(X), roles_of(self)
        by_label = table.one(roles["experiment"], "experiment")
        if by_label is None and groups is not None:
            rule = "hold one label for each row of X"
            with naming_argument("groups", rule, groups):
                check_consistent_length(X, groups)
                groups = column_or_1d(groups)
            by_label = Column("groups", groups)
        by_point = table.one(roles["operating_point"], "operating_point")
        by_kappa = table.several(roles["scheduling"], "scheduling")
        kappa = [column.numbers("X") for column in by_kappa]
        labels, rows = group_rows(by_label, table.n_rows)
        return [
            Experiment(
                label,
                own,
                inputs=np.empty((len(own), 0)),
                scheduling=np.column_stack(kappa)[own] if kappa else None,
                operating_point=operating_point_of(by_point, own, label),
            )
            for label, own in zip(labels, rows, strict=True)
        ]

    @abstractmethod
    def _count(self, X: Any, groups: Any) -> int: ...

    @abstractmethod
    def _parts(self, experiments: list[Experiment]) -> Iterator[Parts]: ...


class ExperimentSplit(_SplitOfExperiments):
    """Folds of whole experiments, or of whole operating points.

    Unlike scikit-learn's ``GroupKFold`` it knows the columns itself (no `groups`), and
    deals the experiments of every operating point evenly to the folds: as long as a
    point has an experiment left, the training set has it.

    Parameters
    ----------
    n_splits : int or "all", default=5
        Number of folds; "all" leaves out one experiment (one point) at a time.
    experiment : column name or position, default=None
        Column that tells experiments apart; None reads `groups` of ``split``.
    scheduling : column name, position or list, default=None
        Experiments are grouped to operating points by the mean of these columns.
    scheduling_tol : float, default=None
        Distance below which experiments belong to one operating point, as in
        `LocalLPVPipeline`; None chooses it from the data.
    operating_point : column name or position, default=None
        Groups them by label instead.
    hold_out : {"experiment", "operating_point"}, default="experiment"
        "operating_point" predicts points that training has not seen.
    interior : bool, default=False
        With ``hold_out="operating_point"``: only points inside the range of the others
        are held out, so that nothing is extrapolated.
    test_on : {"held_out", "all"}, default="held_out"
        What a model is scored on: on what it has not seen, or on all experiments. "all"
        is for choosing a degree (see Notes), not for reporting how good a model is.
    shuffle : bool, default=False
        Whether experiments (points) go to the folds at random.
    random_state : int, RandomState instance or None, default=None
        Of the shuffle.

    Notes
    -----
    Training rows come experiment by experiment, one of every operating point before the
    second of any: a prefix of them, as ``learning_curve`` takes it, covers the
    points as evenly as it can.

    The score of a point left out is taken in a gap twice as wide as any in which the
    model will be used: of few points it favours degrees too low. With ``test_on="all"``
    the gap counts for one place of n, and the mean over the experiments
    (``make_bft_scorer(average="experiment")``) stands for that over the scheduling
    range. Most test samples are training samples then, which flatters high degrees
    where noise in the local models, not interpolation, limits.

    Examples
    --------
    >>> import pandas as pd
    >>> from lpvlearn import ExperimentSplit
    >>> X = pd.DataFrame({"u": 0.0, "kappa": [0.1] * 4 + [0.9] * 4,
    ...                   "run": [1, 1, 2, 2, 3, 3, 4, 4]})
    >>> cv = ExperimentSplit(2, experiment="run", scheduling="kappa")
    >>> for train, test in cv.split(X):
    ...     print(X["run"].iloc[train].unique(), X["run"].iloc[test].unique())
    [2 4] [1 3]
    [1 3] [2 4]
    """

    def __init__(
        self,
        n_splits: int | str = 5,
        *,
        experiment: Any = None,
        scheduling: Any = None,
        scheduling_tol: float | None = None,
        operating_point: Any = None,
        hold_out: str = "experiment",
        interior: bool = False,
        test_on: str = "held_out",
        shuffle: bool = False,
        random_state: Any = None,
    ) -> None:
        self.n_splits = n_splits
        self.experiment = experiment
        self.scheduling = scheduling
        self.scheduling_tol = scheduling_tol
        self.operating_point = operating_point
        self.hold_out = hold_out
        self.interior = interior
        self.test_on = test_on
        self.shuffle = shuffle
        self.random_state = random_state

    def _count(self, X: Any, groups: Any) -> int:
        if not self._wants_all:
            return whole_number("n_splits", self.n_splits, 2)
        if X is None:
            raise ValueError("`X` must be given to count the folds of n_splits='all'.")
        return len(self._folds(*self._points(self._read(X, groups))))

    def _parts(self, experiments: list[Experiment]) -> Iterator[Parts]:
        point, kappa = self._points(experiments)
        for held_out in self._folds(point, kappa):
            kept = np.array([k for k in range(len(point)) if k not in held_out])
            order = kept[np.lexsort((point[kept], _turns(point[kept])))]
            tested = held_out if self.test_on == "held_out" else range(len(point))
            yield (
                [experiments[k].rows for k in order],
                [experiments[k].rows for k in sorted(tested)],
            )

    def _read(self, X: Any, groups: Any) -> list[Experiment]:
        one_of("hold_out", self.hold_out, ("experiment", "operating_point"))
        one_of("test_on", self.test_on, ("held_out", "all"))
        if self.hold_out == "operating_point" and not self._knows_points:
            raise ValueError(
                "`scheduling` or `operating_point` must name a column to hold out "
                "operating points. Got None for both."
            )
        return super()._read(X, groups)

    @property
    def _wants_all(self) -> bool:
        return isinstance(self.n_splits, str) and self.n_splits == "all"

    @property
    def _knows_points(self) -> bool:
        return self.scheduling is not None or self.operating_point is not None

    def _points(self, experiments: list[Experiment]) -> tuple[Indices, Array]:
        """The operating point of every experiment, and the points' values."""
        if not self._knows_points:
            return np.zeros(len(experiments), dtype=np.intp), np.empty((1, 0))
        return group_operating_points(experiments, self.scheduling_tol)

    def _folds(self, point: Indices, kappa: Array) -> list[set[int]]:
        """Numbers of the experiments that every fold holds out."""
        # Neighbours go to different folds: the experiments of one point.
        interior, shuffle = (
            flag("interior", self.interior),
            flag("shuffle", self.shuffle),
        )
        units = [[k] for k in np.argsort(point, kind="stable")]
        if self.hold_out == "operating_point":
            units = [np.flatnonzero(point == k).tolist() for k in range(max(point) + 1)]
            if interior:
                units = list(compress(units, _inner(kappa)))
        n_units = len(units)
        if shuffle:
            rule = "be a whole number from 0 to 2**32 - 1, or None"
            with naming_argument("random_state", rule, self.random_state):
                rng = check_random_state(self.random_state)
            order = rng.permutation(n_units)
            units = [units[k] for k in order]
            if self.hold_out == "experiment":
                units.sort(key=lambda unit: point[unit[0]])
        n_splits = n_units
        if not self._wants_all:
            n_splits = whole_number("n_splits", self.n_splits, 2)
        if not 0 < n_splits <= n_units or len(point) == 1:
            what = self.hold_out.replace("_", " ")
            inside = " inside the range of the others" if interior else ""
            raise ValueError(
                f"`n_splits` must be at most the number of {what}s{inside}. Got "
                f"{self.n_splits!r} for {n_units}. The column `experiment` (or the "
                "argument `groups` of split) tells experiments apart."
            )
        return [
            {k for unit in units[fold::n_splits] for k in unit}
            for fold in range(n_splits)
        ]


def _inner(kappa: Array) -> list[bool]:
    """Which points others surround: convex combinations of these, but for jitter.

    Without scheduling values all but the first and the last.

    >>> _inner(np.array([[0.0, 0.0], [0.0, 2.0], [1.0, 1.0], [2.0, 0.0], [2.0, 2.0]]))
    [False, False, True, False, False]
    """
    if not kappa.shape[1] or len(kappa) < 3:
        return [0 < k < len(kappa) - 1 for k in range(len(kappa))]
    span = np.ptp(kappa, axis=0)
    unit = (kappa - kappa.min(axis=0)) / np.where(span > 0.0, span, 1.0)
    weighed = np.column_stack([unit, np.ones(len(unit))]).T
    return [
        nnls(np.delete(weighed, k, axis=1), weighed[:, k])[1] < _BESIDE
        for k in range(len(unit))
    ]


class BlockedTimeSeriesSplit(_SplitOfExperiments):
    """Folds in time, the same in every experiment: the past trains, the next tests.

    Every experiment is cut into ``n_splits + 1`` blocks of successive samples. Fold k
    trains on the first k blocks of all experiments and tests on block k + 1, after a
    gap. scikit-learn's ``TimeSeriesSplit`` cuts the table instead, whose later rows
    are other experiments.

    Parameters
    ----------
    n_splits : int, default=5
    gap : int, default=0
        Samples left out of every experiment between training and test.
    max_train_size : int, default=None
        Most samples of an experiment to train on, its latest; None is all.
    experiment : column name or position, default=None
        Column that tells experiments apart; None reads `groups` of ``split``, else
        takes the table as one experiment.

    Notes
    -----
    The test parts start in the middle of an experiment, not at rest: score them with
    ``make_bft_scorer(initial_state="estimate")``.

    Examples
    --------
    >>> import numpy as np
    >>> from lpvlearn import BlockedTimeSeriesSplit
    >>> X = np.column_stack([np.zeros(12), np.repeat([0, 1], 6)])
    >>> for train, test in BlockedTimeSeriesSplit(2, experiment=1).split(X):
    ...     print(train, test)
    [0 1 6 7] [2 3 8 9]
    [0 1 2 3 6 7 8 9] [ 4  5 10 11]
    """

    def __init__(
        self,
        n_splits: int = 5,
        *,
        gap: int = 0,
        max_train_size: int | None = None,
        experiment: Any = None,
    ) -> None:
        self.n_splits = n_splits
        self.gap = gap
        self.max_train_size = max_train_size
        self.experiment = experiment

    def _count(self, X: Any, groups: Any) -> int:
        return whole_number("n_splits", self.n_splits, 1)

    def _parts(self, experiments: list[Experiment]) -> Iterator[Parts]:
        n_splits, gap = self.get_n_splits(), whole_number("gap", self.gap, 0)
        longest = self.max_train_size
        if longest is not None:
            longest = whole_number("max_train_size", longest, 1)
        for e in experiments:
            block = len(e.rows) // (n_splits + 1)
            if block <= gap:
                raise ValueError(
                    "`gap` must be shorter than a block of every experiment. Got "
                    f"{gap}, and blocks of {block} samples in experiment {e.label!r} "
                    f"({len(e.rows)} samples, n_splits={n_splits})."
                )
        for fold in range(1, n_splits + 1):
            train, test = [], []
            for e in experiments:
                edges = np.linspace(0, len(e.rows), n_splits + 2).astype(int)
                begin = 0 if longest is None else max(0, int(edges[fold]) - longest)
                train.append(e.rows[begin : edges[fold]])
                test.append(e.rows[edges[fold] + gap : edges[fold + 1]])
            yield train, test


def _turns(point: Indices) -> Indices:
    """How many experiments of the same operating point came before each."""
    return pd.Series(point).groupby(point).cumcount().to_numpy()
