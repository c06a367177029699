"""Tables of the pages of results, which come from CSV files."""

import pytest

from benchmarks.studies import cards
from benchmarks.studies.results import DOCS

PAGES = sorted(page for page in (DOCS / "results").glob("*.md") if page.stem != "appendix")  # which is generated
WORDS = {"index": 800, "speed": 400}


@pytest.mark.parametrize(
    ("cell", "shown"),
    [
        ("0.240 ± 0.003 ± 0.004", "0.240 ± 0.005"),
        ("-.28 ± .12", "-0.28 ± 0.12"),
        ("26.9% ± 4.5%", "26.9% ± 4.5%"),
        ("4.3 ± 0.7 ± –", "4.3 ± –"),
        ("1,834", "1,834"),
        ("z 0.20, 3", "z 0.20, 3"),
        ("–", "–"),
    ],
)
def test_a_cell_has_the_total_error(cell, shown):
    assert cards.with_total(cell) == shown


def test_a_card_has_the_named_rows_and_columns():
    columns = {"ADE (m) ↓": "ADE"}
    table = cards.card("trajevae/scores", columns, {"ours": "trajevae"}, {"given": "2"})
    assert table.header == ["", "ADE (m) ↓"]
    ((name, cell),) = table.rows
    assert name == "ours"
    assert cell.count("±") == 1
    with pytest.raises(ValueError, match="has 5 rows 'trajevae', expected one"):
        cards.card("trajevae/scores", columns, ["trajevae"])
    with pytest.raises(ValueError, match=r"has no columns \['ADF'\]; columns: .*ADE"):
        cards.card("trajevae/scores", {"ADF": "ADF"})


@pytest.mark.parametrize("page", cards.CARDS)
def test_tables_of_a_page_are_those_of_the_files(page):
    assert cards.filled(page, cards.CARDS[page]) == (DOCS / "results" / f"{page}.md").read_text(encoding="utf-8")
    assert all(len(table["columns"]) <= 5 for table in cards.CARDS[page].values())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short(page):
    assert len(page.read_text(encoding="utf-8").split()) <= WORDS.get(page.stem, 600)
