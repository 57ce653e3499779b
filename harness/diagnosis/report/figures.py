"""The pictures of the report, each as one inline SVG text."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.diagnosis.runs.residual_tests import autocorrelation, correlation_band, cross_correlation, cusum_of_squares
from harness.plots import plain_texts
from harness.signals import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, GREY, GRID = "#1d2733", "#8a94a0", "#e3e7ec"
BEFORE, AFTER, DATA = "#d9622b", "#1769aa", "#9aa5b1"
NUMBER, LABEL, BESIDE, BELOW, TITLE, RIGHT = 9.0, 15.0, 9.5, 35.0, 20.0, 9.0
"""Points: of a number on an axis; what a label takes beside the numbers, tick and gap left of a panel, numbers and
label below it, its title, and the last number that stands out to its right."""


@dataclass(frozen=True)
class Overlay:
    """Measured output of one validation record with the simulation before and after."""

    label: str
    unit: str
    t: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray | None


@dataclass(frozen=True)
class ResidualView:
    """Residual of one port against one axis, with the fitted effect on top."""

    axis: str
    unit: str
    x: FloatArray
    before: FloatArray
    after: FloatArray | None
    fitted: FloatArray | None
    residual_unit: str
    port: str
    deviation: float = 0.0
    """Standard deviation of one value, where it is known: drawn as a band about 0."""
    bands: tuple[FloatArray, FloatArray | None] | None = None
    """Standard deviations of the values before and after, where a smoother gives them: drawn around these values."""


@dataclass
class Pictures:
    """All that the figures need; parts that are empty are left out of the report."""

    overlays: list[Overlay] = field(default_factory=list)
    views: list[ResidualView] = field(default_factory=list)
    before: FloatArray | None = None
    after: FloatArray | None = None
    u: FloatArray | None = None
    input_name: str = "u"
    sample_time: float = 1.0
    output_name: str = ""
    isolability: tuple[tuple[str, ...], FloatArray] | None = None
    coverage: list[tuple[str, str, FloatArray, FloatArray, FloatArray, FloatArray]] = field(default_factory=list)


def draw(pictures: Pictures) -> dict[str, str]:
    """Return the figures by name: overlay, residual (and its caption), tests, isolability, coverage."""
    made: dict[str, str] = {}
    if pictures.overlays:
        made["overlay"] = _overlay(pictures.overlays)
    if pictures.views:
        made["residual"] = _residual(pictures.views)
        made["residual_caption"] = _caption(pictures.views)
    if pictures.before is not None:
        made["tests"] = _tests(pictures)
    if pictures.isolability is not None and len(pictures.isolability[0]) > 1:
        made["isolability"] = _isolability(*pictures.isolability)
    if pictures.coverage:
        made["coverage"] = _coverage(pictures.coverage)
    return made


@contextmanager
def drawing(
    name: str, width: float, height: float, words: str, *, measured: bool = False
) -> Iterator[tuple[Figure, list[str]]]:
    """Make a figure without any global state; its SVG text is appended to the list when the block ends.

    ``words`` say what it shows to those who cannot see it. Panels get the room that numbers on their axes, a label and
    a title take; with ``measured`` every text is measured for it, which takes half as long again.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure as MakeFigure

    style: Any = {
        "font.family": "sans-serif",
        "font.sans-serif": ["DejaVu Sans"],
        "font.size": 9,
        "svg.fonttype": "path",
        "svg.hashsalt": name,
        "axes.edgecolor": GREY,
        "axes.labelcolor": INK,
        "axes.titlesize": 9.5,
        "axes.titlecolor": INK,
        "axes.titlelocation": "left",
        "axes.grid": True,
        "axes.axisbelow": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "grid.color": GRID,
        "grid.linewidth": 0.7,
        "xtick.color": GREY,
        "ytick.color": GREY,
        "xtick.labelcolor": INK,
        "ytick.labelcolor": INK,
        "legend.frameon": False,
        "legend.fontsize": 8.5,
        "lines.linewidth": 1.3,
    }
    svg: list[str] = []
    with mpl.rc_context(style):
        figure = MakeFigure(figsize=(width, height), layout="constrained" if measured else None)
        canvas: Any = FigureCanvasSVG(figure)
        yield figure, svg
        plain_texts(figure)
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)
            figure.set_layout_engine("none")
        else:
            _place(figure)
        figure.set_dpi(110)
        for patch in (figure.patch, *(axis.patch for axis in figure.axes)):
            patch.set(facecolor="none", edgecolor="none")
        text = io.StringIO()
        canvas.print_svg(text, metadata={"Date": None})  # savefig would draw the figure twice, to lay it out once more
    whole = text.getvalue()
    begun = whole.index("<svg") + len("<svg")
    svg.append(f'<svg role="img" aria-label="{escape(words, quote=True)}"{whole[begun:]}')


def legend(figure: Figure, markers: float = 2.0) -> None:
    """Put one legend of all that is drawn above the panels, where it covers nothing."""
    lines = {name: line for axis in figure.axes for line, name in zip(*axis.get_legend_handles_labels(), strict=True)}
    measured = figure.get_layout_engine() is not None  # then room is made for what stands outside
    figure.legend(
        lines.values(),
        lines.keys(),
        loc="outside upper left" if measured else "upper left",
        borderaxespad=0.0,
        ncols=min(len(lines), 6),
        markerscale=markers,
    )


def _place(figure: Figure) -> None:
    """Put the panels of a grid under the legend, with the room that their labels take; all sizes in points."""
    panels = [(axis, spec) for axis in figure.axes if (spec := axis.get_subplotspec()) is not None]
    width, whole = 72 * figure.get_size_inches()
    height = whole - sum(key.get_window_extent().height for key in figure.legends) * 72 / figure.dpi
    grid = panels[0][1].get_gridspec()
    rows, columns = grid.get_geometry()
    left, above = np.zeros(columns), np.full(rows, TITLE)
    for axis, _ in panels:  # how many numbers an axis shows depends on its height
        axis.set_position((0.0, 0.0, 1.0 / columns, (height / rows - TITLE - BELOW) / whole))
    for axis, spec in panels:
        numbers, offset = _numbers(axis)
        room = max((sum(map(_em, text)) for text in numbers), default=0.0) * NUMBER + BESIDE
        left[spec.colspan.start] = max(left[spec.colspan.start], room + LABEL * bool(axis.get_ylabel()))
        above[spec.rowspan.start] = max(above[spec.rowspan.start], TITLE + NUMBER * bool(offset))
    shares = np.asarray(grid.get_width_ratios(), dtype=float)
    wide = (width - left.sum() - columns * RIGHT) * shares / shares.sum()
    high = (height - above.sum() - rows * BELOW) / rows
    for axis, spec in panels:
        row, column = spec.rowspan.start, spec.colspan.start
        x = left[: column + 1].sum() + wide[:column].sum() + column * RIGHT
        y = height - above[: row + 1].sum() - row * BELOW - (row + 1) * high
        axis.set_position((x / width, y / whole, wide[column] / width, high / whole))


def _numbers(axis: Axes) -> tuple[list[str], str]:
    """Return the numbers along the ordinate and the power of ten above them."""
    low, high = sorted(axis.get_ylim())
    shown = [place for place in axis.yaxis.get_majorticklocs() if low <= place <= high]
    form = axis.yaxis.get_major_formatter()
    return form.format_ticks(shown), form.get_offset()


def _em(letter: str) -> float:
    """Return the width of a letter of a number in DejaVu Sans over its size."""
    return {".": 0.318, "\N{MINUS SIGN}": 0.838}.get(letter, 0.637)


def _rms(values: FloatArray | None, unit: str) -> str:
    """Return the size of something in words."""
    return "unknown" if values is None else f"{float(np.sqrt(np.nanmean(values**2))):.2g} {unit}"


def _overlay(overlays: Sequence[Overlay]) -> str:
    """Draw measured, before and after, with the error below."""
    shown = overlays[:4]
    words = "; ".join(
        f"{overlay.label}: rms error {_rms(overlay.measured - overlay.before, overlay.unit)} before"
        + ("" if overlay.after is None else f", {_rms(overlay.measured - overlay.after, overlay.unit)} after")
        for overlay in shown
    )
    words = f"Measured and simulated outputs over time, and their difference, on a validation record. {words}."
    with drawing("overlay", 10.5, 2.9 * len(shown), words) as (figure, svg):
        axes = figure.subplots(len(shown), 2, squeeze=False, width_ratios=(1.6, 1.0))
        for (left, right), overlay in zip(axes, shown, strict=True):
            pick = _thin(overlay.t.size, 2500)
            name = "nominal model" if overlay.after is None else "before"
            left.plot(overlay.t[pick], overlay.measured[pick], color=INK, lw=2.6, alpha=0.28, label="measured")
            left.plot(overlay.t[pick], overlay.before[pick], color=BEFORE, lw=1.1, label=name)
            right.plot(overlay.t[pick], (overlay.measured - overlay.before)[pick], color=BEFORE, lw=0.9, label=name)
            if overlay.after is not None:
                left.plot(overlay.t[pick], overlay.after[pick], color=AFTER, lw=1.1, ls=(0, (5, 2)), label="after")
                right.plot(
                    overlay.t[pick], (overlay.measured - overlay.after)[pick], color=AFTER, lw=0.9, label="after"
                )
            left.set(
                title=f"{overlay.label}: measured and simulated",
                xlabel="time [s]",
                ylabel=_axis(overlay.label, overlay.unit),
            )
            right.set(title="measured minus simulated", xlabel="time [s]", ylabel=f"error [{overlay.unit}]")
        legend(figure)
    return svg[0]


def _residual(views: Sequence[ResidualView]) -> str:
    """Draw the residual against each axis: samples, binned mean with its band, fitted effect on top."""
    each = max(Counter(view.port for view in views).values())  # one row for each port, if it has several axes
    columns = min(4, each if each > 1 else max(2, len(views)))
    rows = -(-len(views) // columns)
    name = "before" if any(view.after is not None for view in views) else "nominal model"
    with drawing("residual", 10.5, 2.9 * rows, _residual_words(views)) as (figure, svg):
        axes = figure.subplots(rows, columns, squeeze=False)
        for axis in axes.flat[len(views) :]:
            axis.remove()
        for axis, view in zip(axes.flat, views, strict=False):
            _one_view(axis, view, name)
        legend(figure)
    return svg[0]


def _residual_words(views: Sequence[ResidualView]) -> str:
    """Say what the panels of the residual show."""
    ports: dict[str, list[ResidualView]] = {}
    for view in views:
        ports.setdefault(view.port, []).append(view)
    parts = []
    for port, group in ports.items():
        first = group[0]
        after = "" if first.after is None else f", {_rms(first.after, first.residual_unit)} after"
        axes = ", ".join(view.axis for view in group)
        parts.append(f"{port} against {axes}: rms {_rms(first.before, first.residual_unit)} before{after}")
    return f"What the model leaves. {'; '.join(parts)}."


def _caption(views: Sequence[ResidualView]) -> str:
    """Say what the panels of the residual show."""
    text = "What the nominal part leaves over against each axis: samples, binned mean with the 10–90 % band"  # noqa: RUF001
    if any(view.fitted is not None for view in views):
        return f"{text}, the fitted effect on top, and what is left after it."
    if any(view.after is not None for view in views):
        return f"{text}, and what is left with the effect."
    return f"{text}."


def _one_view(axis: Axes, view: ResidualView, name: str) -> None:
    """Draw one residual panel."""
    if view.bands is not None:
        _smoothed(axis, view, view.before, view.bands[0], BEFORE, name)
        if view.after is not None and view.bands[1] is not None:
            _smoothed(axis, view, view.after, view.bands[1], AFTER, "after")
    else:
        pick = _thin(view.x.size, 4000)
        dense = pick.size > 500
        axis.scatter(
            view.x[pick], view.before[pick], s=2.5 if dense else 9, color=DATA, alpha=0.25 if dense else 0.6, lw=0,
            rasterized=True,
        )  # fmt: skip
        _binned(axis, view.x, view.before, BEFORE, f"{name} (mean, 10-90 %)")
        if view.after is not None:
            _binned(axis, view.x, view.after, AFTER, "after")
    if view.fitted is not None:
        _fitted(axis, view.x, view.fitted)
    shown = view.before if view.after is None else np.concatenate([view.before, view.after])
    low, high = np.quantile(shown, [0.005, 0.995])
    if view.bands is not None:
        wide = 2 * max(float(np.median(band)) for band in view.bands if band is not None)
        low, high = low - wide, high + wide
    if view.deviation > 0:
        axis.axhspan(-2 * view.deviation, 2 * view.deviation, color=GREY, alpha=0.18, lw=0, label="±2 sd of one value")
        low, high = min(low, -2 * view.deviation), max(high, 2 * view.deviation)
    margin = 0.25 * max(high - low, 1e-300)
    axis.set_ylim(low - margin, high + margin)
    axis.set(
        title=f"against {view.axis}",
        xlabel=_axis(view.axis, view.unit),
        ylabel=f"{view.port} [{view.residual_unit}]"
        if view.deviation > 0 or view.bands is not None
        else f"residual of {view.port} [{view.residual_unit}]",
    )


def _smoothed(
    axis: Axes, view: ResidualView, values: FloatArray, deviation: FloatArray, colour: str, label: str
) -> None:
    """Draw a smoothed quantity with two of its standard deviations around it; over time the curve, else by bins.

    Over an axis that is passed many times, a bin holds its median, the smoother's band around that, and in pale how
    the values themselves scatter.
    """
    if view.axis == "time":
        pick = _thin(view.x.size, 2000)
        x, middle, sd = view.x[pick], values[pick], deviation[pick]
    else:
        edges = np.unique(np.quantile(view.x, np.linspace(0, 1, 1 + min(24, max(4, view.x.size // 8)))))
        if edges.size < 3:
            return
        which = np.clip(np.digitize(view.x, edges) - 1, 0, edges.size - 2)
        bins = [inside for k in range(edges.size - 1) if (inside := which == k).sum() >= 5]
        x, middle, sd = (
            np.array([np.median(column[inside]) for inside in bins]) for column in (view.x, values, deviation)
        )
        ends = np.array([np.quantile(values[inside], [0.1, 0.9]) for inside in bins]).reshape(-1, 2)
        axis.fill_between(x, ends[:, 0], ends[:, 1], color=colour, alpha=0.12, lw=0, label=f"{label}: 10-90 %")
    axis.fill_between(x, middle - 2 * sd, middle + 2 * sd, color=colour, alpha=0.35, lw=0, label=f"{label}: ±2 sd")
    axis.plot(x, middle, color=colour, lw=1.0 if view.axis == "time" else 1.6, label=label)


def _binned(axis: Axes, x: FloatArray, y: FloatArray, colour: str, label: str) -> None:
    """Draw binned mean and 10-90 % band of ``y`` over ``x``."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, 1 + min(24, max(4, x.size // 8)))))  # few samples, few bins
    if edges.size < 3:
        return
    which = np.clip(np.digitize(x, edges) - 1, 0, edges.size - 2)
    centre, mean, low, high = [], [], [], []
    for k in range(edges.size - 1):
        inside = which == k
        if inside.sum() >= 5:
            centre.append(float(np.median(x[inside])))
            mean.append(float(y[inside].mean()))
            a, b = np.quantile(y[inside], [0.1, 0.9])
            low.append(float(a))
            high.append(float(b))
    axis.fill_between(centre, low, high, color=colour, alpha=0.14, lw=0)
    axis.plot(centre, mean, color=colour, lw=1.5, marker="o", ms=2.4, label=label)


def _fitted(axis: Axes, x: FloatArray, force: FloatArray) -> None:
    """Draw the fitted effect: its mean over bins of the axis."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, min(60, max(6, x.size // 5)))))
    if edges.size < 3:
        return
    which = np.clip(np.digitize(x, edges) - 1, 0, edges.size - 2)
    count = np.bincount(which, minlength=edges.size - 1)
    good = count >= 3
    mean = np.bincount(which, force, minlength=edges.size - 1)[good] / count[good]
    centre = np.bincount(which, x, minlength=edges.size - 1)[good] / count[good]
    axis.plot(centre, mean, color=INK, lw=1.8, ls=(0, (2, 1.2)), label="fitted effect")


def _tests(pictures: Pictures) -> str:
    """Draw autocorrelation, input cross-correlation and CUSUM of squares, before and after, with 99 % bands."""
    first = "nominal model" if pictures.after is None else "before"
    series = [(pictures.before, BEFORE, first), (pictures.after, AFTER, "after")]
    words = (
        f"Autocorrelation of the residual of {pictures.output_name}"
        + (f", its cross-correlation with {pictures.input_name}" if pictures.u is not None else "")
        + " and its cumulative sum of squares, with 99 % bands: what lies outside is structure that is left."
    )
    with drawing("tests", 10.5, 3.1, words) as (figure, svg):
        panels = figure.subplots(1, 3 if pictures.u is not None else 2)
        for r, colour, label in series:
            if r is None:
                continue
            lags = min(60, r.size // 4)
            rho = autocorrelation(r, lags)
            panels[0].plot(np.arange(1, rho.size), rho[1:], color=colour, marker="o", ms=2.2, lw=1, label=label)
            path, _, _ = cusum_of_squares(r)
            pick = _thin(path.size, 1500)
            panels[-1].plot(pick * pictures.sample_time, path[pick], color=colour, label=label)
            if pictures.u is not None:
                cross = cross_correlation(pictures.u, r, lags)
                panels[1].plot(np.arange(-lags, lags + 1), cross, color=colour, lw=1, label=label)
        n = pictures.before.size if pictures.before is not None else 1
        for panel in panels:
            panel.axhspan(-correlation_band(n), correlation_band(n), color=GREY, alpha=0.22, lw=0, label="99 % band")
            panel.axhline(0, color=GREY, lw=0.7)
        panels[0].set(title=f"autocorrelation of the residual of {pictures.output_name}", xlabel="lag [samples]")
        panels[-1].set(title="CUSUM of squares", xlabel="time [s]")
        if pictures.u is not None:
            panels[1].set(title=f"cross-correlation with {pictures.input_name}", xlabel="lag [samples]")
        legend(figure)
    return svg[0]


def _isolability(names: Sequence[str], cosines: FloatArray) -> str:
    """Draw the matrix of cosines."""
    n = len(names)
    size = min(10.5, 2.6 + 0.3 * n)
    alike = [f"{names[i]} and {names[j]}" for i in range(n) for j in range(i) if abs(cosines[i, j]) >= 0.9]
    words = f"How alike {n} effects look in these data. " + (
        f"Nearly the same: {', '.join(alike[:12])}{' and more' if len(alike) > 12 else ''}." if alike
        else "No two are nearly the same."
    )  # fmt: skip
    with drawing("isolability", size, size * 0.86, words, measured=True) as (figure, svg):
        axis = figure.subplots()
        image = axis.imshow(np.abs(cosines), vmin=0, vmax=1, cmap="Blues", interpolation="nearest")
        axis.set_xticks(range(n), names, rotation=60, ha="right", rotation_mode="anchor", fontsize=7.5)
        axis.set_yticks(range(n), names, fontsize=7.5)
        axis.grid(False)
        for i in range(n):
            for j in range(n):
                if i != j and abs(cosines[i, j]) >= 0.9:
                    text = f"{abs(cosines[i, j]):.2f}".lstrip("0")
                    axis.text(j, i, text, ha="center", va="center", color="white", fontsize=6.2)
        figure.colorbar(image, ax=axis, shrink=0.75, label="|cosine| (1: cannot be told apart)")
    return svg[0]


def _coverage(panels: Sequence[tuple[str, str, FloatArray, FloatArray, FloatArray, FloatArray]]) -> str:
    """Draw where in (q, v) the estimation and the validation records went."""
    shown = panels[:3]
    words = f"Where position and speed of {', '.join(p[0] for p in shown)} went, in estimation and validation records."
    with drawing("coverage", 10.5, 3.3, words) as (figure, svg):
        axes: Any = figure.subplots(1, max(len(shown), 2), squeeze=False)
        for spare in axes[0][len(shown) :]:
            spare.remove()
        for axis, (name, unit, q, v, qv, vv) in zip(axes[0], shown, strict=False):
            a, b = _thin(q.size, 3000), _thin(qv.size, 3000)
            axis.scatter(q[a], v[a], s=2, color=DATA, lw=0, alpha=0.5, rasterized=True, label="estimation")
            axis.scatter(qv[b], vv[b], s=2, color=AFTER, lw=0, alpha=0.4, rasterized=True, label="validation")
            axis.set(title=f"coverage of {name}", xlabel=_axis(name, unit), ylabel=_axis(f"{name}'", f"{unit}/s"))
        legend(figure, markers=6.0)
    return svg[0]


def _axis(name: str, unit: str) -> str:
    """Return an axis label."""
    return f"{name} [{unit}]" if unit not in ("", "1") else name


def _thin(n: int, most: int) -> FloatArray:
    """Return at most about ``most`` indices spread over ``n`` samples."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).astype(int))
