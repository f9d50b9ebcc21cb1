"""Fill the tables and figures of the documents from the result files of benchmarks, docs/results/*.json.

    ./run -- python docs/tables.py            # write
    ./run -- python docs/tables.py --check    # fail if a document differs from the files

A benchmark writes a result file with its option `--json`. In README.md and docs/*.md, a table stands between
`<!-- table NAME -->` and `<!-- end -->`, where NAME is a key of `TABLES`. A figure stands between
`<!-- value FILE ROW QUANTITY [FORMAT] -->` and `<!-- end -->`. ROW is a row of the file, or a summary of all
rows: `mean` (geometric), `least`, `most`, `each`, or `losses` (rows below 1).
"""

import argparse
import json
import math
import re
import statistics
import sys
from functools import cache
from pathlib import Path

from result_tables import TABLES

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
MARKED = re.compile(r"(<!-- (table|value) ([^>]*?) -->)(.*?)(<!-- end -->)", re.DOTALL)


class Number(float):
    """Number with two more formats: `r`, two significant digits, and `r%`, the same of a percentage."""

    def __format__(self, spec):
        if spec in ("r", "r%"):
            value = float(f"{100 * self if spec == 'r%' else self:.2g}")
            digits = max(0, 1 - math.floor(math.log10(abs(value)))) if value else 0
            exact = value if digits else round(100 * self if spec == "r%" else self)
            return f"{exact:.{digits}f}{spec[1:]}".replace("-", "−")
        return super().__format__(spec).replace("-", "−")


@cache
def result(name):
    """The result file of a name, with every number as a `Number`."""
    return json.loads((RESULTS / f"{name}.json").read_text(), parse_float=Number, parse_int=Number)


def quantity(row, path):
    """The value at a dotted path of a row, or None."""
    for name in path.split("."):
        row = row.get(name) if isinstance(row, dict) else None
    return row


def geometric_mean(values):
    return Number(statistics.geometric_mean(values))


def machine(name):
    """Cores and vector width of the machine of a result file."""
    found = result(name)["machine"]
    return f"{found['cores']:.0f} cores, {found['vector_width']:.0f}-wide vectors"


def sources(table):
    """Commands, commits, dates and machines of the files of a table."""
    return "\n".join(f"- `{name}.json`: {source(name)}." for files in table.files.values() for name in files)


def origins(table):
    """Last rows of a brief table: the equal error of each column, and the commits of its files."""
    cells = []
    for column in table.columns:
        found = [result(name) for name in table.files[column.ratio.partition(".")[0]]]
        cells.append(", ".join(dict.fromkeys(f"`{one['commit']}`" for one in found)))
    return [["equal error", *(column.measure for column in table.columns)], ["commit", *cells]]


def source(name):
    """Command, commit, date and machine of a result file."""
    found = result(name)
    copied = ", figures copied by hand from what the command printed" if found.get("transcribed") else ""
    return f"`{found['command']}`; commit `{found['commit']}`, {found['date']}, {machine(name)}{copied}"


def rows_of(table):
    """Rows of a table from all files, as {row: quantities}, in the order of the table."""
    rows = {}
    for name, files in table.files.items():
        for file in files:
            for label, row in result(file)["rows"].items():
                rows.setdefault(label, {}).update({name: row} if name else row)
    if table.order:
        rows = dict(sorted(rows.items(), key=lambda item: -(quantity(item[1], table.order) or 0)))
    return rows


def ratio_text(value):
    """A ratio with two digits, bold below 1."""
    return f"**{value:r}**" if value < 1 else f"{value:r}"


def cell(column, row):
    """Text of a cell, empty if the row lacks a quantity."""
    if column.ratio:
        value = quantity(row, column.ratio)
        text = "" if value is None else ratio_text(value)
    else:
        try:
            text = column.cell.format(**row)
        except KeyError:
            text = ""
    return column.sign + text if text and column.bound and quantity(row, column.bound) else text


def table_text(name):
    """Markdown of a table: sources, rows, and geometric means of ratios."""
    table = TABLES[name]
    rows = rows_of(table)
    lines = [[table.first, *(column.title for column in table.columns)], ["---"] * (len(table.columns) + 1)]
    lines += [[label, *(cell(column, row) for column in table.columns)] for label, row in rows.items()]
    means = ["geometric mean"]
    for column in table.columns:
        known = {label: value for label, row in rows.items() if (value := quantity(row, column.ratio)) is not None}
        is_bound = any(quantity(rows[label], column.bound) for label in known)
        sign = column.sign if is_bound else ""
        means.append(sign + ratio_text(geometric_mean(known.values())) if len(known) > 1 else "")
    if any(means[1:]):
        lines.append(means)
    if table.is_brief:
        lines += origins(table)
    head = "" if table.is_brief else f"{sources(table)}\n\n"
    return f"\n{head}" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n\n"


def value_text(words):
    """Text of a figure: `FILE ROW QUANTITY [FORMAT]`."""
    file, row, path, *spec = words.split()
    spec = spec[0] if spec else "r"
    values = {label: quantity(found, path) for label, found in result(file)["rows"].items()}
    values = {label: value for label, value in values.items() if value is not None}
    if row in ("mean", "least", "most"):
        return format({"mean": geometric_mean, "least": min, "most": max}[row](values.values()), spec)
    if row in ("each", "losses"):
        kept = [item for item in values.items() if row == "each" or item[1] < 1]
        return ", ".join(f"{label} {value:{spec}}" for label, value in sorted(kept, key=lambda item: -item[1]))
    return format(values[row], spec)


def filled(text):
    """Replace every table and figure between markers in the text of a document."""

    def replaced(match):
        start, kind, name, _, end = match.groups()
        try:
            return start + (table_text(name) if kind == "table" else value_text(name)) + end
        except (KeyError, ValueError, OSError) as error:
            raise SystemExit(f"{kind} {name!r}: {type(error).__name__}: {error}") from error

    return MARKED.sub(replaced, text)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a document differs from the files")
    options = parser.parse_args()
    differing = []
    for page in DOCUMENTS:
        old = page.read_text()
        if (new := filled(old)) != old:
            differing.append(str(page.relative_to(ROOT)))
            if not options.check:
                page.write_text(new)
    for name in differing:
        print(f"{name} differs from docs/results" if options.check else f"wrote {name}")
    return int(options.check and bool(differing))


if __name__ == "__main__":
    sys.exit(main())
