"""Labels of rows: alike, in another order, of other rows."""

import numpy as np
import pandas as pd
import pytest

from lpvlearn.data.alignment import align_outputs

X = pd.DataFrame({"u": np.arange(6.0)}, index=list("abcdef"))
Y = pd.DataFrame({"y": 10 * np.arange(6.0)}, index=list("abcdef"))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("series", [False, True])
@pytest.mark.parametrize(
    "index",
    [
        list("abcdef"),
        [5, 3, 8, 1, 0, 2],
        pd.date_range("2024-03-30", periods=6, freq="12h", tz="Europe/Paris"),
        pd.MultiIndex.from_product([["p", "q"], [0.0, 0.1, 0.2]], names=["run", "t"]),
        pd.Categorical(list("fedcba")),
    ],
    ids=["text", "numbers", "dates", "levels", "categories"],
)
def test_another_order_is_put_right(index, series, seed):
    X, Y = (table.set_axis(index) for table in (globals()["X"], globals()["Y"]))
    y = Y["y"] if series else Y
    assert align_outputs(X, y) is y
    order = np.random.default_rng(seed).permutation(6)
    with pytest.warns(UserWarning, match="row labels of X in another order"):
        found = align_outputs(X, y.iloc[order])
    assert found.index.equals(X.index)
    np.testing.assert_array_equal(found, y)


@pytest.mark.parametrize(
    ("own", "given"),
    [
        (X, Y.reset_index(drop=True)),
        (X.reset_index(drop=True), Y),
        (X.set_index("u"), Y.reset_index(drop=True)),  # 0.0 is not the label 0
        (X, Y["y"].tolist()),
        (X.to_numpy(), Y[::-1]),
        (X.set_axis([1, 2, 1, 2, 1, 2]), Y.reset_index(drop=True)),
        (X.set_axis([1, 2, 1, 2, 1, 2]), Y.set_axis([1, 2, 1, 2, 1, 2])),
        (X[3:].set_axis([7, 8, 9]), Y[3:].reset_index(drop=True)),
        (X.rename_axis("run"), Y.set_axis(list("uvwxyz"))),
    ],
)
def test_rows_without_common_labels_belong_together_as_they_stand(own, given):
    assert align_outputs(own, given) is given


def test_no_outputs_stay_none():
    assert align_outputs(X, None) is None


@pytest.mark.parametrize(
    ("own", "given", "message"),
    [
        (X[:4], Y[2:], r"Got 2 label\(s\) that X does not have, the first 'e', and 2"),
        (X, Y[:-1], r"inconsistent numbers of samples: \[6, 5\]"),
        (X.to_numpy(), [1.0], r"inconsistent numbers of samples: \[6, 1\]"),
        (
            X.set_axis(list("aabbcc")),
            Y.set_axis(list("abcabc")),
            "Got 'a' several times",
        ),
    ],
)
def test_what_cannot_be_put_right_is_refused(own, given, message):
    with pytest.raises(ValueError, match=message):
        align_outputs(own, given)
