"""What the library says, in the words of the command."""

from lpvlearn.command.ending import in_options


def test_the_command_has_options_for_what_the_library_advises():
    said = in_options(
        "Splits must keep experiments whole; where they cannot, score with "
        "make_bft_scorer(initial_state='estimate') or, of samples after the transient, "
        "make_bft_scorer(burn_in=...)."
    )
    assert said.endswith("where they cannot, take --initial-state estimate.")
    assert in_options("Name the `inputs`.") == "Name the `--inputs`."
