"""Formulas as MathML, which browsers draw without a library from the network."""

from docutils import nodes
from docutils.utils.math import latex2mathml


def _inline(visitor, node):
    visitor.body.append(latex2mathml.tex2mathml(node.astext()))
    raise nodes.SkipNode


def _block(visitor, node):
    formula = latex2mathml.tex2mathml(node.astext(), as_block=True)
    visitor.body.append(f'<div class="formula">{formula}</div>')
    raise nodes.SkipNode


def setup(app):
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    return {"parallel_read_safe": True}
