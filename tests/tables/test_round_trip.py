"""Random tables, written to CSV and read back: values survive in float64, and every exception is named."""

import csv
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from dvae.tables import Column, Columns
from dvae.tables.reading import read_panel

pd = pytest.importorskip("pandas")

WORDS = ["07", "7", "7.0", "1E5", "100000", "NA", "None", "nan", "0x10", "16", "true"]
WORDS += ["é", "a,b", "a;b", 'say "x"', "-", "?"]
"""Texts that a reader could take for something else."""
NUMBERS = {
    "noise": lambda random, n: random.normal(size=n),
    "offset": lambda random, n: 1e9 + random.normal(size=n),
    "pressure": lambda random, n: 101325 + 0.01 * random.normal(size=n),
    "tiny": lambda random, n: random.normal(size=n) * 1e-30,
    "counts": lambda random, n: random.poisson(3, n).astype(float),
    "large": lambda random, n: random.integers(2**52, 2**53, n).astype(float),
    "halves": lambda random, n: random.integers(-9, 9, n) / 2,
    "constant": lambda random, n: np.full(n, 2.5),
    "sales": lambda random, n: random.integers(700, 2500, n).astype(float),
}
STEPS = {"day": "D", "hour": "h", "month": "MS", "business day": "B", "quarter": "QS", "minute": "min"}
CLOCKS = {
    "iso": lambda times: {"when": times.strftime("%Y-%m-%d %H:%M")},
    "zone": lambda times: {"when": times.strftime("%Y-%m-%dT%H:%M+02:00")},
    "utc": lambda times: {"when": times.strftime("%Y-%m-%d %H:%M:%SZ")},
    "words": lambda times: {"when": times.strftime("%d %b %Y %H:%M")},
    "split": lambda times: {"date": times.strftime("%Y-%m-%d"), "clock": times.strftime("%H:%M:%S")},
    "half days": lambda times: {"date": times.strftime("%Y/%m/%d"), "clock": times.strftime("%I:%M %p")},
    "parts": lambda times: {
        name: times.strftime(how)
        for name, how in {"year": "%Y", "month": "%m", "day": "%d", "hour": "%H", "minute": "%M"}.items()
    },
}


class Table(SimpleNamespace):
    """Cells (N) of each column as text, with their roles and true values."""

    def __init__(self):
        super().__init__(cells={}, ids=[], times=[], columns=[], values=[], sequence=None, seconds=None, marks=0)


def numeral(value, decimal, thousands):
    text = repr(float(value))
    if thousands and "e" not in text:
        integer, _, fraction = text.partition(".")
        text = f"{int(integer):,}".replace(",", thousands) + (f"{decimal}{fraction}" if fraction else "")
        return text if value >= 0 or text.startswith("-") else f"-{text}"
    return text.replace(".", decimal)


def draw(random, separator):
    """A table with random roles, types, steps, gaps and order of rows."""
    table, number = Table(), random.integers(1, 5)
    table.decimal = "," if random.random() < (0.1 if separator == "," else 0.5) else "."
    names = [str(each) for each in random.choice(WORDS, number, replace=False)]
    rows = [(n, t) for n in range(number) for t in range(random.integers(3, 12)) if t < 3 or random.random() < 0.8]
    sequence, step = np.array(rows).T
    clock = random.choice(["none", "numbers", *CLOCKS])
    if clock != "none" and random.random() < 0.5:
        order = random.permutation(len(step)) if random.random() < 0.5 else np.lexsort([sequence, step])
        sequence, step = sequence[order], step[order]
    if number > 1 or random.random() < 0.3:
        table.ids = ["station"] if random.random() < 0.7 else ["region", "line"]
        table.cells["station" if len(table.ids) == 1 else "line"] = [names[n] for n in sequence]
        if len(table.ids) > 1:
            table.cells["region"] = [["n", "NA"][n % 2] for n in sequence]
    if clock == "numbers":
        scale, offset = random.choice([1, 0.25, 1e3]), random.choice([0.0, -7.0, 1e9])
        table.seconds = offset + scale * step
        table.cells["step"] = [numeral(each, table.decimal, "") for each in table.seconds]
        table.times = ["step"]
    elif clock != "none":
        times = pd.date_range("2023-12-20", periods=12, freq=STEPS[random.choice([*STEPS])])[step]
        table.seconds = times.to_numpy("datetime64[s]").astype(float) - (7200 if clock == "zone" else 0)
        clock_cells = CLOCKS[clock](times)
        table.cells |= {name: list(cells) for name, cells in clock_cells.items()}
        table.times = [*clock_cells]
    table.sequence = sequence
    return table


def fill(table, random):
    """Add columns of data; cells of some are missing."""
    count, missing = len(table.sequence), ["", "NaN", "NA", "null", "?"]
    for index in range(random.integers(1, 5)):
        role = "target" if not index else str(random.choice(["target", "known", "past"]))
        absent = random.random(count) < random.choice([0, 0, 0.2])
        absent[:2] = False
        if random.random() < 0.3:
            classes = [str(each) for each in random.choice(WORDS, random.integers(2, 5), replace=False)]
            codes = np.concatenate([np.arange(2), random.integers(0, len(classes), count)])[:count]
            table.columns.append(Column(f"c{index}", role, "category", classes=tuple(classes)))
            table.cells[f"c{index}"] = [
                "" if is_absent else classes[n] for n, is_absent in zip(codes, absent, strict=True)
            ]
            table.values.append(np.where(absent, np.nan, codes))
            continue
        kind = str(random.choice([*NUMBERS]))
        values = NUMBERS[kind](random, count)
        group = {".": ",", ",": "."}[table.decimal] if random.random() < (0.7 if kind == "sales" else 0.2) else ""
        suffix = (
            f"{table.decimal}0" if kind == "sales" else " "
        )  # sales have no fraction, so only thousands have a sign
        mark = str(random.choice(missing))
        table.marks += mark == "?" and absent.any()
        table.columns.append(Column(f"{kind}{index}", role))
        table.cells[f"{kind}{index}"] = [
            mark if is_absent else numeral(value, table.decimal, group).removesuffix(suffix)
            for value, is_absent in zip(values, absent, strict=True)
        ]
        table.values.append(np.where(absent, np.nan, values))


def write(table, random, path, separator):
    """Write a table in a random encoding and dialect of CSV."""
    names = [str(each) for each in random.permutation([*table.cells])]
    encoding = str(random.choice(["utf-8", "utf-8-sig", "utf-16"]))
    with path.open("w", encoding=encoding, newline="") as file:
        head = random.choice(["", "", "# made up\n", f"sep={separator}\n"])
        file.write(str(head))
        quoting = csv.QUOTE_ALL if random.random() < 0.2 or len(names) == 1 else csv.QUOTE_MINIMAL
        end = str(random.choice(["\n", "\r\n"]))
        writer = csv.writer(file, delimiter=separator, quoting=quoting, lineterminator=end)
        writer.writerow(names)
        writer.writerows(zip(*(table.cells[name] for name in names), strict=True))
        if empty := random.integers(0, 3) * (random.random() < 0.2) * (len(names) > 1):
            writer.writerows([[""] * len(names)] * empty)
    return int(empty)


def check_exact(table, panel):
    """Check that every sequence has its own rows, in the order of time, with exact values."""
    keys = list(zip(*(table.cells[name] for name in table.ids), strict=True)) or [("0",)] * len(table.sequence)
    assert sorted(one.name for one in panel) == sorted({"/".join(key) for key in keys})
    values = np.stack(table.values, 1)
    for one in panel:
        rows = np.array([n for n, key in enumerate(keys) if "/".join(key) == one.name])
        if table.seconds is not None:
            rows = rows[np.argsort(table.seconds[rows])]
            np.testing.assert_array_equal(one.times, table.seconds[rows])
        np.testing.assert_array_equal(one.values, values[rows])


def check_named(table, panel, message):
    """Check that every column is in the schema or a warning, and that all values of a column are exact."""
    columns = panel.columns
    for name in table.cells:
        assert name in columns.needed or f"{name!r}" in message, f"{name} is dropped: {message}"
    assert sum(map(len, panel)) == len(table.sequence)
    truth = {column.name: (column, values) for column, values in zip(table.columns, table.values, strict=True)}
    for index, column in enumerate(columns.columns):
        read_values = np.concatenate([one.values[:, index] for one in panel])
        if column.name not in truth:
            continue
        true_column, values = truth[column.name]
        if true_column.family == column.family == "category":
            read_values = np.sort([column.classes[int(n)] for n in read_values[~np.isnan(read_values)]])
            values = np.sort([true_column.classes[int(n)] for n in values[~np.isnan(values)]])
        elif "category" in (true_column.family, column.family):
            continue  # texts that are all numbers, or numbers with a warning
        np.testing.assert_array_equal(np.sort(read_values), np.sort(values))
    if columns.id == tuple(table.ids) and len(columns.times) == len(table.times) and table.seconds is not None:
        for one in panel:
            assert np.isin(one.times, table.seconds).all()


def check(seed, path):
    """Write a random table, and read it with its schema and without one."""
    random = np.random.default_rng(seed)
    separator = str(random.choice([",", ";", "\t"]))
    table = draw(random, separator)
    fill(table, random)
    doubled = table.seconds is not None and random.random() < 0.1
    if doubled:
        table.cells = {name: [*cells, cells[0]] for name, cells in table.cells.items()}
    empty = write(table, random, path, separator)
    columns = Columns(tuple(table.columns), tuple(table.ids), tuple(table.times) or None, decimal=table.decimal)
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            if doubled:
                with pytest.raises(ValueError, match="has two rows at"):
                    read_panel(path, columns)
                return "doubled"
            panel = read_panel(path, columns)
        messages = [str(each.message) for each in warned]
        assert sum("empty rows at the end" in each for each in messages) == bool(empty)
        assert sum("holds '?'" in each for each in messages) == table.marks == len(messages) - bool(empty)
        check_exact(table, panel)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                proposed = read_panel(path)
            except ValueError as error:
                return str(error)
        check_named(table, proposed, " ".join(str(each.message) for each in warned))
    except Exception as error:
        error.add_note(f"seed {seed}: {path.read_bytes()[:600]!r}")
        raise
    return ""


def test_tables_survive_csv_or_have_a_warning(tmp_path):
    errors = [check(seed, tmp_path / "a.csv") for seed in range(70)]
    assert sum(map(bool, errors)) < 35  # most are read without a schema
    assert max(map(len, errors)) < 1000
