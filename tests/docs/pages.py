"""The pages of the documentation, and the Python that stands in them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# A budget is an integer with an underscore; with 600 timesteps every algorithm makes an update
BUDGET = re.compile(r"\b\d{1,3}(?:_\d{3})+\b")
SMALL = "600"
# Estimates and certificates from ten episodes or more: from eight they have all of their parts
EPISODES = re.compile(r"\b(n(?:_eval)?_episodes=)\d{2,}\b")
NOT_RUN = re.compile(r"<!-- not run: .+ -->\n")
BLOCK = re.compile(rf"({NOT_RUN.pattern})?^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def name_of(page):
    """A page's path in the repository."""
    return str(page.relative_to(ROOT))


def shortened(code):
    """Code with small budgets."""
    return EPISODES.sub(r"\g<1>8", BUDGET.sub(SMALL, code))


def source_of(page):
    """The Python blocks of a page that run, one after the other, on the lines where they stand."""
    text = page.read_text()
    lines = [""] * text.count("\n")
    for block in BLOCK.finditer(text):
        if block[1] is None:
            first = text.count("\n", 0, block.start(2))
            code = block[2].splitlines()
            lines[first : first + len(code)] = code
    return shortened("\n".join(lines)).rstrip() + "\n"


def examples():
    """The pages with Python that runs."""
    return [page for page in PAGES if source_of(page).strip()]
