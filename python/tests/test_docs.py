"""The Python of the documentation runs, page by page from the first snippet to the last."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FENCED = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
SNIPPETS = {
    page.stem: FENCED.findall(page.read_text(encoding="utf-8"))
    for page in [*sorted((ROOT / "docs").glob("*.md")), ROOT / "python" / "README.md"]
    if not page.is_symlink()
}
PAGES = [name for name, snippets in SNIPPETS.items() if snippets]


def test_there_are_snippets():
    assert {"index", "optimisation", "README"} <= set(PAGES)


@pytest.mark.filterwarnings("ignore::rowgram.RowgramWarning")
@pytest.mark.parametrize("page", PAGES)
def test_the_snippets_of_a_page_run(page, flight, monkeypatch):
    # Snippets speak of a project "field".
    monkeypatch.chdir(flight.root.parent)
    names = {}
    for number, code in enumerate(SNIPPETS[page], 1):
        exec(compile(code, f"{page}, snippet {number}", "exec"), names)
