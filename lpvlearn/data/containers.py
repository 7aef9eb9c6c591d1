"""What `predict` returns: an array, or a DataFrame where `set_output` says so."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from ..validation import one_of

_CONTAINERS = ("default", "pandas", "polars", None)


def row_labels(X: Any) -> pd.Index | None:
    """Those of a table of pandas; any other has none."""
    return X.index if isinstance(X, pd.DataFrame | pd.Series) else None


class OutputContainer:
    """An estimator of which `set_output` chooses the container of predictions.

    The choice stands where scikit-learn keeps that of transformers: `clone`, and with
    it searches and cross-validation, takes it along.
    """

    _single_output: bool

    def set_output(self, *, transform: str | None = None) -> Self:
        """Choose what `predict` and its like return, as scikit-learn's transformers do.

        Parameters
        ----------
        transform : {"default", "pandas", "polars"}, default=None
            Arrays, or tables with the names of the outputs; those of pandas have the
            row labels of X. None leaves the choice as it is.

        Returns
        -------
        self
        """
        one_of("transform", transform, _CONTAINERS)
        if transform is not None:
            self._sklearn_output_config = {"transform": transform}
        return self

    def _remember_shape(self, y: Any) -> None:
        """Predictions have one dimension where the outputs of the fit had."""
        self._single_output = np.asarray(y).ndim == 1

    def _contained(
        self, found: NDArray[np.float64], X: Any, names: Sequence[Hashable] | None
    ) -> Any:
        """Outputs (n_samples, n_outputs) in the rows of X, as fitted and chosen."""
        found = found[:, 0] if self._single_output else found
        wanted = getattr(self, "_sklearn_output_config", {}).get("transform", "default")
        if wanted == "default":
            return found
        columns = found.reshape(len(found), -1)
        if names is None:
            names = [f"y{k + 1}" for k in range(columns.shape[1])]
        if wanted == "polars":
            from polars import DataFrame

            return DataFrame(columns, schema=[str(name) for name in names])
        return pd.DataFrame(columns, row_labels(X), list(names))
