"""Plots of error against time and shadow rays, as SVG."""

import io

import matplotlib
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

from . import analysis, tables

# Colours by Okabe and Ito, distinguishable with all types of colour vision; after the last, the marker changes
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
MARKERS = "osD^vP"
AXES = {"seconds": "time of the image [s]", "rays": "shadow rays per pixel"}
ERRORS = {"relmse": "relMSE", "relmse_trimmed": "relMSE, trimmed", "rmse": "RMSE", "relative_l1": "relative L1 error"}
STYLE = {
    "svg.fonttype": "none",  # keeps text as text
    "svg.hashsalt": "comparison",  # makes the file reproducible
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888",
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), "#010203"),
    "grid.color": "#040506",
}
# Replacements by CSS colours of the page, light or dark
PAGE_COLOURS = {"#010203": "currentColor", "#040506": "var(--line)", "#ffffff": "var(--page)"}


def colour(index):
    """Return the colour of the label with this index."""
    return COLOURS[index % len(COLOURS)]


def error_against(cost, points, best, labels, metric):
    """Plot error against a cost ("seconds" or "rays"), both logarithmic; return SVG text, None without points.

    `points`: `curves.Point`s; `best`: the set of (label, name) on the Pareto front, marked by rings. Bars are
    confidence intervals of the means. Points below the reference's noise are hollow and not part of a curve.
    """
    if not points:
        return None
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 4.4), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot(xscale="log", yscale="log", xlabel=AXES[cost], ylabel=ERRORS[metric])
        axes.grid(True, which="major")
        axes.set_axisbelow(True)
        for index, label in enumerate(labels):
            _draw(axes, index, label, [point for point in points if point.label == label], best)
        for axis in (axes.xaxis, axes.yaxis):
            _tick(axis)
        _name(figure, axes, points, labels, best)
        if best:
            axes.plot([], [], "o", markersize=11, markerfacecolor="none", markeredgecolor="#777", label="Pareto front")
        axes.legend(frameon=False, fontsize=9)
        return _svg(figure)


def error_bars(points, labels, metric):
    """Plot the errors of `curves.Point`s, at most one per label, as bars with intervals and seconds; return SVG text.
    A bar hidden by the reference's noise is hollow and has the length of that noise."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 0.9 + 0.42 * len(points)), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot(xlabel=ERRORS[metric])
        axes.grid(True, axis="x")
        axes.set_axisbelow(True)
        for row, point in enumerate(points):
            seconds, error = analysis.spread_of(point)
            own, bound = colour(labels.index(point.label)), point.bound()
            length, face = (bound[1], "white") if bound else (error["mean"], own)
            axes.barh(row, length, height=0.62, facecolor=face, edgecolor=own, xerr=None if bound else _bars(error),
                      error_kw={"elinewidth": 0.9, "capsize": 2, "ecolor": "#010203"})  # fmt: skip
            text = f"{'< ' if bound else ''}{tables.number(length)}, {tables.number(seconds['mean'])} s"
            end = length if bound or error["high"] is None else error["high"]
            axes.annotate(text, (end, row), xytext=(5, 0), textcoords="offset points", va="center", fontsize=9)
        axes.set_yticks(range(len(points)), [f"{point.label} {point.name}".strip() for point in points])
        axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        axes.margins(x=0.28)
        axes.set_xlim(left=0)
        return _svg(figure)


def _draw(axes, index, label, points, best):
    style = {"color": colour(index), "marker": MARKERS[index // len(COLOURS) % len(MARKERS)], "linestyle": "none"}
    for curve in analysis.make_curves(points, [label]):
        axes.plot(*curve.front(), color=style["color"], linewidth=1.6, label=label)
    for point in points:
        x, y = analysis.spread_of(point)
        if x["mean"] <= 0 or y["mean"] <= 0:
            continue
        shown = point.mean() is not None
        axes.errorbar(
            x["mean"], y["mean"], xerr=_bars(x), yerr=_bars(y), markersize=5, elinewidth=0.9, capsize=2,
            markerfacecolor=style["color"] if shown else "white", **style,
        )  # fmt: skip
        if (point.label, point.name) in best:
            axes.plot(x["mean"], y["mean"], "o", markersize=11, markerfacecolor="none", markeredgecolor="#777")


def _name(figure, axes, points, labels, best):
    """Annotate points with their settings where space permits, starting with the Pareto front."""
    figure.draw_without_rendering()
    taken = []
    for point in sorted(points, key=lambda point: (point.label, point.name) not in best):
        mean = point.mean()
        if not point.name or mean is None:
            continue
        shown = axes.annotate(
            point.name, mean, xytext=(7, 5), textcoords="offset points", fontsize=7.5,
            color=colour(labels.index(point.label)),
        )  # fmt: skip
        box = shown.get_window_extent()
        if any(box.overlaps(other) for other in taken):
            shown.remove()
        else:
            taken.append(box)


def _bars(spread):
    if spread["low"] is None:
        return None
    return np.array([[spread["mean"] - spread["low"]], [spread["high"] - spread["mean"]]])


def _tick(axis):
    """Label powers of ten; in ranges below two decades, also their multiples by 2 and 5."""
    low, high = axis.get_view_interval()
    if high / low < 100:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(lambda value, _: tables.number(value))
    else:
        axis.set_major_formatter(LogFormatterSciNotation())
    axis.set_minor_formatter(NullFormatter())


def _svg(figure):
    """Return a figure as an SVG element for embedding in a page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    content = buffer.getvalue()
    for drawn, of_page in PAGE_COLOURS.items():
        content = content.replace(drawn, of_page)
    return content[content.index("<svg") :]
