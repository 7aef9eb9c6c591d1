"""
The paper's experiment, at reduced size
=======================================

A planar arm with two bending links, identified at seven elbow angles and validated on
a sweep through all of them: Section 3 of the paper, with two noise realizations
instead of one hundred. The full size is one command, ``python -m lpvlearn``.
"""

# %%
# Everything in one call. The result holds the data, the fitted pipeline, the LPV models
# and the tables.

from lpvlearn.paper import run_paper_experiment

experiment = run_paper_experiment(n_realizations=2, degree=2, random_state=0)

# %%
# The four tables of the paper, this library's figures beside the published ones. The
# physical parameters of the paper's arm are not published: this arm is another one,
# calibrated so that the *analytic* rows come out near the paper's. Compare the
# differences between the models, not single figures.

from lpvlearn.paper import tables_text

print(tables_text(experiment))

# %%
# What the local models hold: Bode magnitudes at the first angle, where the arm is
# nearly stretched, beside the linearised equations and an arm with rigid links (Fig.
# 4).

from lpvlearn.paper import draw_balanced, draw_bode, draw_parameters

figure, title = draw_bode(experiment)

# %%
# The sixteen parameters over the scheduling variable (Fig. 5). Identified and analytic
# parameters follow the same smooth curves: all local models share one state basis.

figure, title = draw_parameters(experiment)

# %%
# Entries of the balanced black-box models (Fig. 6) follow no law: some jump from one
# point to the next.

figure, title = draw_balanced(experiment)

# %%
# The test: the elbow turns through its whole range in three seconds (Fig. 8 and 10).
# The model from restructured local models is as good as the one from the exact
# linearisations, the balanced one drifts away.

from lpvlearn.inspection import SimulationDisplay

sweep = experiment.data.X_sweep
display = SimulationDisplay.from_predictions(
    sweep["time"],
    experiment.data.y_sweep,
    {
        name: experiment.lpv[name].simulate(
            sweep[["u1", "u2"]], sweep["kappa"], experiment.data.sampling_time
        )
        for name in ("restructured", "balanced")
    },
    units="rad/s",
    true_name="arm, without noise",
)
