r"""
.. _how_to_keep:

Save, load, and go on with a stream
===================================

A model outlives the session in which it was made: in a file, with what one must know to
trust it later, or as a model that new samples keep improving.
"""

# %%
# Save and load
# -------------
# :func:`~lpvlearn.save` writes numbers and text, no code: a file may come from anybody,
# and later versions of the library read it. What it holds: :ref:`guide_files`.

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

from lpvlearn import LocalLPVPipeline, SubspaceLTI, load, save
from lpvlearn.datasets import load_varying_spring

spring = load_varying_spring()
roles = {"scheduling": "kappa", "experiment": "run", "time": "time"}
pipeline = LocalLPVPipeline(**roles).fit(spring.X, spring.y)

folder = Path(tempfile.mkdtemp())
save(pipeline, folder / "spring.zip")
loaded = load(folder / "spring.zip")
bool((loaded.predict(spring.X) == pipeline.predict(spring.X)).all(axis=None))

# %%
# A model alone is smaller, and needs no estimator around it:

save(pipeline.lpv_, folder / "model.zip")
{path.name: path.stat().st_size for path in sorted(folder.iterdir())}

# %%
# Versions
# --------
# A file knows which version wrote it. What it does not know is your data: keep, beside
# the file, their name and a checksum, and the code of the fit, which the report prints
# (:meth:`~lpvlearn.LocalLPVPipeline.to_html_report`).

import hashlib
import json
import platform
import zipfile

import lpvlearn

with zipfile.ZipFile(folder / "spring.zip") as file:
    written = json.loads(file.read("model.json"))["lpvlearn"]
digest = hashlib.sha256(pd.util.hash_pandas_object(spring.X).to_numpy()).hexdigest()
{
    "written by": written,
    "read by": lpvlearn.__version__,
    "python": platform.python_version().rsplit(".", 1)[0],
    "data": digest[:12],
}

# %%
# Pickles work as well, between equal versions and among those you trust; another
# version gives a ``VersionWarning``.
#
# Stream
# ------
# ``partial_fit`` takes batches as they come, keeps a summary of a fixed size in place
# of the samples, and has the same model as ``fit`` on all of them. The label in
# ``experiment`` tells that a batch goes on where the last one ended.

one = spring.X["run"] == spring.X["run"].iloc[0]
X, y = spring.X.loc[one, ["force", "run", "time"]], spring.y[one]
options = {"order": 2, "horizon": 10, "experiment": "run", "time": "time"}

stream = SubspaceLTI(**options)
batches = np.array_split(np.arange(len(X)), 6)
course = {}
for number, rows in enumerate(batches, start=1):
    stream.partial_fit(X.iloc[rows], y.iloc[rows])
    pole = stream.lti_.to_continuous().poles()
    course[number] = {"frequency": np.abs(pole[0]), "samples": rows[-1] + 1}
whole = SubspaceLTI(**options).fit(X, y)
course["fit"] = {
    "frequency": np.abs(whole.lti_.to_continuous().poles()[0]),
    "samples": len(X),
}
pd.DataFrame(course).T.round(4)
