"""``lpvlearn`` and ``python -m lpvlearn``: words, and the paper without one."""

import pytest

import lpvlearn
from lpvlearn import __main__ as command
from lpvlearn.__main__ import main


@pytest.mark.parametrize("option", ["--realizations", "--degree", "--jobs"])
@pytest.mark.parametrize("word", [[], ["paper"]])
def test_counts_below_one_are_refused(
    option: str, word: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([*word, option, "0"])
    assert "must be an integer, at least 1. Got 0." in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["--seed", "3"], ["paper", "--seed", "3"]])
def test_without_a_word_it_is_the_paper(arguments, monkeypatch):
    asked = []
    monkeypatch.setattr(command, "_paper", asked.append)
    assert main(arguments) == 0
    assert asked[0].seed == (3 if arguments else 0)
    assert (asked[0].realizations, asked[0].method) == (100, "po-moesp")


@pytest.mark.parametrize("word", ["fit", "predict", "report"])
def test_help_shows_examples(word, capsys):
    with pytest.raises(SystemExit) as end:
        main([word, "--help"])
    assert end.value.code == 0
    assert f"examples:\n  lpvlearn {word} " in capsys.readouterr().out


def test_other_words_are_refused(capsys):
    with pytest.raises(SystemExit) as end:
        main(["identify"])
    assert end.value.code == 2
    assert "invalid choice: 'identify'" in capsys.readouterr().err


def test_the_version_is_told(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"lpvlearn {lpvlearn.__version__}\n"
