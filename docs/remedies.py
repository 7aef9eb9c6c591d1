"""What the page of messages says beside their texts, where these do not say all.

`ABOUT` belongs to a section; `REMEDIES` to the message that begins with its key.
"""

ABOUT = {
    "Tables and column roles": "How a table should look: :ref:`guide_data`. Time, gaps "
    "and labels of a log: :ref:`guide_logs`.",
    "Local models": "What is identified at an operating point, and how to judge it: "
    ":ref:`guide_local`.",
    "Structures": "How to write one: :ref:`how_to_plants`.",
    "Restructuring": "What the search does, and its certificates: "
    ":ref:`guide_restructuring`.",
    "LPV models and interpolation": "Forms of the interpolation: "
    ":ref:`guide_interpolation`; simulation: :ref:`guide_simulation`.",
    "The pipeline": "The steps on one table: :ref:`guide_tools`; offsets: "
    ":ref:`guide_points_of_work`; data that move: :ref:`guide_refinement`.",
    "Files": "What a file holds: :ref:`guide_files`. Errors that name no argument "
    'stand behind "must be a whole file that ``save`` of this library wrote": the file '
    "is damaged, or of another program. Take another copy, or save the model anew.",
    "Scores and reports": "What the scores mean: :ref:`guide_validation`.",
    "The command": "All options: :ref:`command`, or ``lpvlearn fit --help``.",
}

_CELL = "A cell of a template holds a sum of names with factors, as ``2*k - 1``."

REMEDIES = {
    # -- warnings
    "`…` has the row labels of … in another order": "Nothing is wrong if the labels "
    "are right; give arrays if they mean nothing.",
    "…: it cannot be written": "What the system says stands in brackets: free space, "
    "make the folder, or take a place where you may write.",
    "Input column": "A role that was forgotten makes a column an input, and the "
    "model explains the outputs by it.",
    "All experiments are at one operating point": "See `scheduling_tol`, if they are "
    "not.",
    "The scored table starts in mid-motion": "A split in time does that; see "
    ":ref:`guide_validation`.",
    "The scheduling variables are far from zero": "The model itself is exact; only the "
    "list of coefficients loses digits.",
    "Scheduling values must be within the identified range": "Local experiments "
    "tell nothing beyond the outermost ones.",
    "One of the models is so hard to stabilise": "Remove states that are hardly "
    "reached or seen: ``model.balance(order=...)``.",
    "`refiner` has nothing to do": "Add a record along which the scheduling "
    "variable moves, or leave `refiner` out.",
    "`memory` holds an entry that is damaged": "Nothing to do; if it comes again, "
    "empty the folder.",
    "… of … realisations were left out": "Look at the records that failed: they are "
    "often constant, cut short, or unstable.",
    "left out …": "The point is missing in the LPV model, which interpolates over it. "
    "Mend what the message names, or measure there again.",
    "the parameters … may have changed places": "See :ref:`guide_restructuring`.",
    "the values of … may be those of one another at all operating points": "See "
    ":ref:`guide_restructuring`.",
    "inputs or outputs stand away from zero": "See :ref:`guide_points_of_work`.",
    "the structure comes no nearer": "Compare the responses by ``BodeDisplay``: where "
    "they part, the structure lacks something, or the black box is wrong.",
    "the response determines": "Parameters along these directions are not wrong but "
    "arbitrary; the response is right.",
    "The inputs know the noise of the outputs": "See :ref:`guide_local`.",
    "The simulation error depends on past inputs": "Judge by the error itself: a lack "
    "that is far below the noise is harmless.",
    "with `integrating`, the errors and their statistics": "``model.rates_`` tests and "
    "predicts the rates, of which its table is made.",
    "The errors of … are rounding": "Nothing to do: the data are noise-free.",
    "The first … samples of the stream leave it without a model": "Begin with samples "
    "in which all inputs vary.",
    "A pickled": "Pickles belong to the version that wrote them; see "
    ":ref:`guide_files`.",
    "the experiments at one operating point have": "See :ref:`guide_points_of_work`.",
    "The experiments of `fit` have": "See :ref:`guide_points_of_work`.",
    "`lpv_` is unstable at values within": "An operating point or an experiment there "
    "decides; a lower degree, or momenta as states, often suffice: "
    ":ref:`guide_interpolation`, :ref:`guide_state_basis`.",
    # -- errors
    "--degree is that of": "Add ``--interpolation polynomial``, or leave ``--degree`` "
    "out.",
    "…: column … is in …, too": "A column has one role: take it out of one of the "
    "options.",
    "… lacks the column(s)": "Name the columns as in the table of the fit.",
    "… lacks outputs to compare with": "Give a table with the outputs of the fit.",
    "--output …: there is": "Take another name.",
    "there is no such file": "Check the path; it counts from the current folder.",
    "…: there is no such file": "Check the path; it counts from the current folder.",
    "a structure of the form": "Leave out what it does not take.",
    "… holds no rows": "The file has a head and nothing below it: export it again.",
    "… cannot be read": "Open it in an editor: often the separator or the decimal mark "
    "differs (``--separator``, ``--decimal``).",
    "…: the table has no column": "Names are compared exactly, with capitals and "
    "spaces.",
    "Complex data not supported": "Give real and imaginary parts as columns.",
    "Experiment … must be local": "Where one record holds several levels, cut it as "
    ":ref:`how_to_log` shows.",
    "Experiment …: …": "The text after the colon is explained at its own place.",
    "the simulation diverges": "The model is unstable, or is taken where it is: see "
    "``poles()`` or ``frozen_poles(kappa)``.",
    "model …: …": "The text after the colon is explained at its own place.",
    "the starting point of the": "Give an `init` whose model is stable.",
    "…: every operating point failed": "What is wrong with all of them is most often a "
    "role, a unit, or `order`.",
    "`start` has": "Fit on the columns that the model was made for.",
    "the model is not minimal": "Some states are not reached or not seen: lower "
    "`order`.",
    "… by finite values": "Leave that value out of the range, or interpolate by "
    "another form: a rational one may have a pole there.",
    "… is out of place": _CELL,
    "it ends early": _CELL,
    "… characters, more than": _CELL,
    "nested more than": _CELL,
    "division by zero": _CELL,
    "not a number": "Values of parameters are numbers.",
    "not affine": "A template holds sums of parameters with factors; products and "
    "functions of them go into a function.",
    "… is not a parameter name": "With `parameter_names` given, cells may hold these "
    "only.",
    "The covariance": "The models themselves are right; only their standard deviations "
    "are not known.",
    "sections of": "The file is damaged.",
    "a covariance not of": "The file is damaged.",
    "The QR iteration did not converge": "The model holds numbers of very different "
    "sizes: scale inputs, outputs or time.",
    "A pole lies on the boundary": "The gain is infinite there: an integrator or an "
    "undamped mode. Leave its frequency out.",
    "…. Got … s, and … s in column": "All experiments and tables of a model have one "
    "sampling time: see :func:`~lpvlearn.resample`.",
    "…. Got shape … for": "One row of scheduling values is one point.",
}
