"""Singular values of a subspace identification, and the order chosen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..data.tables import as_numbers
from ..metrics.table_simulation import unwrapped
from .drawing import ACCENT, INK, MUTED, TEXT_SIZE, drawable, single_axes, tidy, whole

_MOST_SHOWN = 10**6  # no picture shows more

_N_SHOWN = 30  # values that are told apart in a figure of 8 inches


class SingularValueDisplay:
    """Singular values of the observability subspace; those of the order stand out.

    A gap after the order tells that the data hold no more states. Make it with
    `from_estimator` or `from_values`.

    Parameters
    ----------
    singular_values : array-like of shape (n_values,)
        Descending, not negative.
    order : int, default=None
        The chosen order; None marks none.

    Attributes
    ----------
    ax_ : Axes
    axes_ : ndarray of Axes of shape (1,)
    figure_ : Figure
    lines_ : dict from str to Line2D
        "kept" and "left": the values up to the order, and beyond.

    Examples
    --------
    >>> from lpvlearn.inspection import SingularValueDisplay
    >>> display = SingularValueDisplay.from_values([9.0, 4.0, 1e-3, 8e-4], order=2)
    >>> display.lines_["kept"].get_ydata()
    array([9., 4.])
    """

    def __init__(self, singular_values: ArrayLike, order: int | None = None) -> None:
        values = as_numbers("singular_values", singular_values)
        if values.ndim != 1 or not values.size or not (values >= 0).all():
            raise ValueError(
                "`singular_values` must be a vector of non-negative numbers. Got "
                f"shape {values.shape}."
            )
        if not 0 < values[0] < np.inf:
            raise ValueError(
                "`singular_values` must begin with the largest, finite and not zero. "
                f"Got {values[0]}."
            )
        if order is not None:
            order = whole("order", order, range(len(values) + 1))
        self.singular_values = values
        self.order = order

    @classmethod
    def from_values(
        cls, singular_values: ArrayLike, order: int | None = None, *, ax: Any = None
    ) -> SingularValueDisplay:
        """Draw given singular values.

        Parameters
        ----------
        singular_values : array-like of shape (n_values,)
        order : int, default=None
        ax : Axes, default=None

        Returns
        -------
        SingularValueDisplay
        """
        return cls(singular_values, order).plot(ax)

    @classmethod
    def from_estimator(
        cls, subspace: Any, *, n_shown: int = _N_SHOWN, ax: Any = None
    ) -> SingularValueDisplay:
        """Draw the singular values of a fitted subspace estimator.

        Parameters
        ----------
        subspace : fitted SubspaceLTI
        n_shown : int, default=30
            Largest number of values drawn.
        ax : Axes, default=None

        Returns
        -------
        SingularValueDisplay

        Raises
        ------
        ValueError
            If the estimator is not fitted.
        """
        subspace = unwrapped(subspace)
        if not hasattr(subspace, "singular_values_"):
            raise ValueError(
                "`subspace` must be a fitted SubspaceLTI: call its fit() first. Got "
                f"{type(subspace).__name__} without `singular_values_`."
            )
        display = cls(subspace.singular_values_, subspace.order_)
        return display.plot(ax, n_shown=n_shown)

    def plot(self, ax: Any = None, *, n_shown: int = _N_SHOWN) -> SingularValueDisplay:
        """Draw the values.

        Parameters
        ----------
        ax : Axes, default=None
            None makes a figure.
        n_shown : int, default=30
            Largest number of values drawn, never fewer than twice the order.

        Returns
        -------
        SingularValueDisplay
        """
        from matplotlib.ticker import MaxNLocator

        self.figure_, self.axes_ = single_axes(ax, height=3.4)
        self.ax_ = one = self.axes_[0]
        order = 0 if self.order is None else self.order
        most = whole("n_shown", n_shown, range(1, _MOST_SHOWN))
        values = self.singular_values[: max(most, 2 * order)]
        # Rounding leaves zeros, which a logarithmic axis cannot show.
        values = np.maximum(values, np.finfo(float).eps * values[0])
        bottom = values.min() / 3.0
        number = np.arange(1, len(values) + 1)
        kept = number <= order
        one.set_yscale("log")
        one.vlines(number[kept], bottom, values[kept], color=ACCENT, linewidth=1.6)
        one.vlines(number[~kept], bottom, values[~kept], color="0.75", linewidth=1.2)
        self.lines_ = {}
        for name, mask, colour, face in (
            ("kept", kept, ACCENT, ACCENT),
            ("left", ~kept, INK, "white"),
        ):
            (self.lines_[name],) = one.plot(
                number[mask],
                values[mask],
                linestyle="none",
                marker="o",
                markersize=5.5,
                color=colour,
                markerfacecolor=face,
            )
        if self.order is not None:
            one.axvline(order + 0.5, color=MUTED, linewidth=1.0, linestyle="--")
            one.annotate(
                f"order {order}",
                (order + 0.5, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(5, -2),
                textcoords="offset points",
                va="top",
                fontsize=TEXT_SIZE + 0.5,
            )
        tidy(one)
        one.set_ylim(bottom=bottom)
        one.set_xlim(0.2, len(values) + 0.8)
        one.xaxis.set_major_locator(MaxNLocator(integer=True))
        one.set_xlabel("Index")
        one.set_ylabel("Singular value")
        drawable(self.figure_)
        return self
