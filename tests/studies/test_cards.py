"""Tables of the pages of results agree with the CSV files."""

import pytest

from benchmarks.studies import cards
from benchmarks.studies.results import DOCS

PAGES = sorted(page for page in (DOCS / "results").glob("*.md") if page.stem != "appendix")  # a generated page
WORDS = {"index": 800, "speed": 520}  # with the table of a GPU


@pytest.mark.parametrize(
    ("cells", "printed"),
    [
        (["0.240 ± 0.003 ± 0.004", "0.5 ± 0.26"], ["0.2 ± 0.0", "0.5 ± 0.3"]),
        (["-.28 ± .12", "0"], ["-.28 ± 0.12", "0"]),
        (["26.9% ± 4.5%"], ["26.9% ± 4.5%"]),
        (["4.3 ± 0.7 ± –", "–"], ["4.3 ± –", "–"]),
        (["1,834", "z 0.20, 3", "at most 1.2"], ["1,834", "z 0.20, 3", "at most 1.2"]),
    ],
)
def test_cells_have_the_total_error_and_the_same_decimals(cells, printed):
    assert cards.aligned(cells) == printed


def test_a_card_has_the_named_rows_and_columns():
    """The first cells name a row; a column is named without ↓ or ↑."""
    rows = {"two paths": ["trajevae", "2"], "neighbours": "nearest neighbours"}
    columns = {"ADE (m) ↓": "ADE", "KL": ["family/teacher-forced", "ELBO"]}
    with pytest.raises(ValueError, match="no source has the column KL"):
        cards.card(columns, rows, "trajevae/scores")
    columns["KL"] = ["family/free-running", "energy score"]
    table = cards.card(columns, rows | {"dkf": "dkf"}, ["family/free-running", "trajevae/scores"])
    assert table.header == ["", "ADE (m) ↓", "KL"]
    assert [row[0] for row in table.rows] == ["two paths", "neighbours", "dkf"]
    assert [row[1].count("±") for row in table.rows] == [1] * 3
    assert [row[2] for row in table.rows[:2]] == ["–", "–"]
    with pytest.raises(ValueError, match="no source has the row cvae"):
        cards.card(columns, ["cvae", "dkf"], "family/free-running")
    with pytest.raises(ValueError, match="trajevae/scores has 5 rows trajevae; add their next cells"):
        cards.card(columns, ["trajevae"], "trajevae/scores")


def test_a_table_without_a_source_is_a_sentence():
    """With a source, rows without a value stay."""
    tables = cards.CARDS["speed"]
    missing = tables | {"gpu": tables["gpu"] | {"source": "speed/missing"}}
    assert f"<!-- table: gpu -->\n\n{tables['gpu']['absent']}\n\n<!--" in cards.fill_page("speed", missing)
    rows = {"`srnn`": "speed: srnn", "failed": "graphs: kvae"}
    text = cards.fill_page("speed", tables | {"gpu": tables["gpu"] | {"source": "speed/history", "rows": rows}})
    assert "| `srnn` | at most 1.6 |" in text
    assert "| failed | – | – | – |" in text


@pytest.mark.parametrize("page", cards.CARDS)
def test_tables_of_a_page_agree_with_the_files(page):
    assert cards.fill_page(page, cards.CARDS[page]) == (DOCS / "results" / f"{page}.md").read_text(encoding="utf-8")
    assert all(len(table["columns"]) <= 5 for table in cards.CARDS[page].values())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short(page):
    assert len(page.read_text(encoding="utf-8").split()) <= WORDS.get(page.stem, 600)
