"""Columns of tables, by whatever names them."""

import numpy as np
import pandas as pd
import pytest

from lpvlearn.data.tables import as_list


@pytest.mark.parametrize(
    "names",
    [["a", "b"], ("a", "b"), np.array(["a", "b"]), pd.Index(["a", "b"]),
     pd.Series(["a", "b"], index=[3, 5]), pd.DataFrame(["a", "b"]),
     np.array([["a"], ["b"]], dtype=object)],
    ids=["list", "tuple", "array", "index", "series", "table", "column"],
)  # fmt: skip
def test_names_of_columns_in_any_container_are_a_list(names):
    assert as_list(names) == ["a", "b"]
    assert as_list("ab") == ["ab"] and as_list(None) == [] and as_list(0) == [0]
