"""Files as loggers and spreadsheets write them are the table that they hold."""

import warnings

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from lpvlearn.command.tables import Format, read_tables, with_times

NAMES = ["Zeit", "Strom [A]", "Winkel"]


@pytest.fixture
def table():
    start = pd.Timestamp("2024-03-04 23:59:59")
    return pd.DataFrame(
        {
            "Zeit": start + pd.to_timedelta(0.05 * np.arange(40), unit="s"),
            "Strom [A]": np.r_[np.zeros(20), np.linspace(-1.5, 1.5, 20)],
            "Winkel": np.sin(np.arange(40.0)).round(6),
        }
    )


def german(table):
    text = table.assign(Zeit=table["Zeit"].dt.strftime("%d.%m.%Y %H:%M:%S,%f"))
    return text.to_csv(sep=";", decimal=",", index=False)


def read(path, *, unit=None, **form):
    found = read_tables([path], Format(**form), None, label=True)
    return with_times(found.rows, "Zeit", unit, found.units).rows, found.units


def check(found, table):
    assert list(found) == NAMES
    assert_allclose(found["Zeit"].diff().dt.total_seconds()[1:], 0.05)
    assert_allclose(found[NAMES[1:]], table[NAMES[1:]], atol=1e-9)


def with_units(text):
    head, _, rest = text.partition("\n")
    return f"{head}\n[s];[A];rad\n{rest}"


LOGS = {
    "comma": lambda t: t.to_csv(index=False),
    "decimal commas": german,
    "after titles": lambda t: "Messung;;\nAnn\n\n" + german(t),
    "a line of units": lambda t: with_units(german(t)),
    "lines that end in a separator": lambda t: german(t).replace("\n", ";\n"),
    "tabs": lambda t: t.to_csv(sep="\t", index=False),
    "blanks": lambda t: t.to_csv(sep=" ", index=False),
    "numbers of the rows": lambda t: t.to_csv(),
    "a comment": lambda t: "# made by hand\n# " + t.to_csv(index=False),
    "dates with zones": lambda t: t.assign(
        Zeit=[x.isoformat() for x in t["Zeit"].dt.tz_localize("Europe/Berlin")]
    ).to_csv(index=False),
    "days before months": lambda t: t.assign(
        Zeit=(t["Zeit"] + pd.Timedelta(days=20)).dt.strftime("%d/%m/%Y %H:%M:%S.%f")
    ).to_csv(index=False),
}


@pytest.mark.parametrize("kind", LOGS)
def test_the_layout_of_text_is_found(tmp_path, table, kind):
    path = tmp_path / "a.txt"
    path.write_text(LOGS[kind](table), encoding="utf-8")
    found, units = read(path)
    check(found, table)
    expected = {"Zeit": "s", "Strom [A]": "A", "Winkel": "rad"}
    assert units == (expected if kind == "a line of units" else {})


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_encodings_are_found(tmp_path, table, encoding):
    path = tmp_path / "a.csv"
    path.write_text(german(table).replace("Winkel", "Höhe"), encoding=encoding)
    assert list(read(path)[0]) == ["Zeit", "Strom [A]", "Höhe"]
    assert list(read(path, encoding=encoding)[0])[2] == "Höhe"


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_numbers_since_1970_are_dates_and_others_have_their_unit(
    tmp_path, table, unit, factor
):
    path = tmp_path / "a.csv"
    since = (table["Zeit"] - pd.Timestamp(0)) // pd.Timedelta(1, unit)
    table.assign(Zeit=since).to_csv(path, index=False)
    check(read(path)[0], table)
    told = with_times(table.assign(Zeit=since), "Zeit", None, {}).told
    assert f"taken as {unit} since 1970, from 2024-03-04 23:59:59; --time-" in told
    table.assign(Zeit=0.05 * factor * np.arange(40)).to_csv(path, index=False)
    assert_allclose(read(path, unit=unit)[0]["Zeit"], 0.05 * np.arange(40))


@pytest.mark.parametrize(
    ("name", "units", "seconds"),
    [
        ("t", {"t": "ms"}, 1e-3),
        ("t", {"t": "µs"}, 1e-6),
        ("t [ms]", {}, 1e-3),
        ("t (Minutes)", {}, 60.0),
        ("Zeit / ms", {}, 1e-3),
        ("clock_ns", {}, 1e-9),
        ("t [ms]", {"t [ms]": "s"}, 1.0),
        ("t_max", {}, 1.0),
        ("ms", {}, 1.0),
    ],
)
def test_units_that_a_table_tells_are_those_of_its_times(name, units, seconds):
    table = pd.DataFrame({name: np.arange(5)})
    found = with_times(table, name, None, units)
    assert_allclose(found.rows[name], seconds * np.arange(5), rtol=1e-15)
    assert ("as the table tells" in found.told) == (seconds != 1.0)
    given = with_times(table, name, "h", units)  # which counts more
    assert_allclose(given.rows[name], 3600.0 * np.arange(5))


def test_a_unit_that_is_none_of_time_is_told():
    table = pd.DataFrame({"t": np.arange(5)})
    with pytest.warns(UserWarning, match="as seconds: their unit 'd' is none of s, ms"):
        found = with_times(table, "t", None, {"t": "d"})
    assert_allclose(found.rows["t"], np.arange(5))


@pytest.mark.parametrize(
    ("unit", "begin"), [("ns", 5 * 10**14), ("us", 5 * 10**14), ("ms", 10**13)]
)
def test_numbers_that_make_no_dates_ask_for_their_unit(table, unit, begin):
    step = pd.Timedelta("50ms") // pd.Timedelta(1, unit)
    table["Zeit"] = begin + step * np.arange(40)
    with pytest.raises(ValueError, match="'Zeit' must have a unit.*as --time-unit"):
        with_times(table, "Zeit", None, {})
    found = with_times(table, "Zeit", unit, {})
    assert_allclose(found.rows["Zeit"].diff()[1:], 0.05, rtol=1e-4)
    assert found.told == ""


@pytest.mark.parametrize("text", ["{:02.0f}:{:04.1f}", "{:.0f}:{:05.2f}"])
def test_two_fields_with_a_decimal_are_minutes_and_seconds(tmp_path, table, text):
    path = tmp_path / "a.csv"
    seconds = 58.0 + 0.1 * np.arange(40)
    times = [text.format(s // 60, s % 60) for s in seconds.round(6)]
    table.assign(Zeit=times).to_csv(path, index=False)
    found = read(path)[0]["Zeit"]
    assert_allclose((found - found[0]) / pd.Timedelta("1s"), seconds - 58.0, atol=1e-6)


def test_two_fields_without_are_hours_and_minutes_and_that_is_told(tmp_path, table):
    path = tmp_path / "a.csv"
    table.assign(Zeit=[f"00:{k:02d}" for k in range(40)]).to_csv(path, index=False)
    with pytest.warns(
        UserWarning, match="'00:00' are read as hours and minutes.*give hours as well"
    ):
        found = read(path)[0]["Zeit"]
    assert_allclose(found.diff()[1:] / pd.Timedelta("1s"), 60.0)


@pytest.mark.parametrize(
    ("text", "step"), [("{}:{:02d}:{:02d}", 70.0), ("{}:{:02d}", 4200.0)]
)
@pytest.mark.filterwarnings("ignore:Times as .* are read as hours and minutes")
def test_clocks_go_on_after_a_day(tmp_path, table, text, step):
    path = tmp_path / "a.csv"
    seconds = 23 * 3600 + int(step) * np.arange(40)
    times = [text.format(s // 3600, s // 60 % 60, s % 60) for s in seconds]
    table.assign(Zeit=times).to_csv(path, index=False)
    found = read(path)[0]["Zeit"]
    assert_allclose(found.diff()[1:] / pd.Timedelta("1s"), step)
    times[5] = None
    lost = with_times(table.assign(Zeit=times), "Zeit", None, {}).rows["Zeit"]
    assert lost.isna().sum() == 1
    assert (lost.drop(5) == found.drop(5)).all()


def test_tables_without_names_say_what_their_columns_are_called(tmp_path, table):
    path = tmp_path / "a.csv"
    table[NAMES[1:]].to_csv(path, index=False, header=False)
    with pytest.warns(UserWarning, match="use c1 to c2, or give"):
        assert list(read(path)[0]) == ["c1", "c2"]


def test_several_files_are_as_many_experiments(tmp_path, table):
    (tmp_path / "b").mkdir()
    paths = [tmp_path / "a.csv", tmp_path / "b" / "a.csv", tmp_path / "c.csv"]
    for k, path in enumerate(paths):
        table.assign(run=k % 2, Winkel=float(k)).to_csv(path, index=False)
    found = read_tables(paths, Format(), None, label=True)
    assert found.experiment == "experiment"
    assert found.rows.groupby("experiment")["Winkel"].first().to_dict() == {
        "a": 0.0,
        "a (2)": 1.0,
        "c": 2.0,
    }
    found = read_tables(paths, Format(), "run", label=False)
    assert list(found.rows["run"].unique()) == ["a: 0", "a (2): 1", "c: 0"]
    table.to_csv(paths[2], index=False)
    with pytest.warns(UserWarning, match="left out that not every table has: 'run'"):
        assert "run" not in read_tables(paths, Format(), None, label=True).rows


def test_a_unit_of_one_is_none_and_a_first_sample_of_ones_is_no_row_of_units(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("run,t,u,y\n-,s,1,[1]\n0,0.0,1,2\n0,0.1,1,3\n")
    found = read_tables([path], Format(), None, label=True)
    assert found.units == {"t": "s"}
    assert found.rows["y"].tolist() == [2, 3]
    path.write_text("t,u,y\n1,1,-\n2,1,0.5\n3,1,0.7\n")
    found = read_tables([path], Format(), None, label=True)
    assert found.units == {} and len(found.rows) == 3


def test_sheets_of_the_same_columns_are_experiments(tmp_path, table):
    pytest.importorskip("openpyxl")
    path = tmp_path / "a.xlsx"
    with pd.ExcelWriter(path) as book:
        pd.DataFrame({"by": ["Ann"]}).to_excel(book, sheet_name="Info", index=False)
        for name in ("V1", "V2"):
            table.to_excel(book, sheet_name=name, startrow=2, startcol=1, index=False)
    with pytest.warns(
        UserWarning, match="left out: 'Info'. Give them the columns of 'V1'"
    ):
        found = read_tables([path], Format(), None, label=True)
    assert list(found.rows["experiment"].unique()) == ["a V1", "a V2"]
    check(found.rows[NAMES].iloc[:40], table)
    table.to_excel(path, index=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(read(path)[0], table)
