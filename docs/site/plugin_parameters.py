"""Directive `pluginparameters` of Mitsuba's manual: a list of lists (name, type, description), shown as a table.

Docstrings have the list first, as in Mitsuba. Pages show the table after the first paragraph of the description.
"""

from docutils import nodes
from sphinx.transforms import SphinxTransform
from sphinx.util.docutils import SphinxDirective

TITLES, WIDTHS = ("Parameter", "Type", "Description"), (20, 12, 68)


class PluginParameters(SphinxDirective):
    """Table of parameters. The content is a list of lists of three entries: name, type, description."""

    has_content = True

    def run(self):
        parsed = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, parsed)
        if len(parsed) != 1 or not isinstance(parsed[0], nodes.bullet_list):
            raise self.error("pluginparameters takes one list")
        rows = [[cell.children for cell in entry[0]] for entry in parsed[0]]
        for row in rows:
            if len(row) != len(TITLES):
                raise self.error(f"pluginparameters takes lists of {len(TITLES)}, got one of {len(row)}")
            name = row[0][0].astext()
            row[0] = [nodes.paragraph("", "", nodes.literal(name, name, classes=["paramname"]))]
        return [_table(rows)]


class AfterDescription(SphinxTransform):
    """Move tables of parameters behind the next paragraph."""

    default_priority = 400

    def apply(self):
        for table in list(self.document.findall(nodes.table)):
            if "paramstable" in table["classes"]:
                paragraph = table.next_node(nodes.paragraph, descend=False, siblings=True)
                table.parent.remove(table)
                paragraph.parent.insert(paragraph.parent.index(paragraph) + 1, table)


def _table(rows):
    group = nodes.tgroup("", *(nodes.colspec(colwidth=width) for width in WIDTHS), cols=len(WIDTHS))
    group += nodes.thead("", _row([nodes.paragraph(text=title)] for title in TITLES))
    group += nodes.tbody("", *map(_row, rows))
    return nodes.table("", group, classes=["paramstable", "colwidths-given"])


def _row(cells):
    return nodes.row("", *(nodes.entry("", *content) for content in cells))


def setup(app):
    app.add_directive("pluginparameters", PluginParameters)
    app.add_transform(AfterDescription)
    return {"parallel_read_safe": True}
