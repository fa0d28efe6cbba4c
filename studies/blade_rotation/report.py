"""The report page: one HTML file that needs nothing beside it, of the results that a store holds; and their table.

It says what its intervals carry. A number of the study is told to lie inside or outside the interval, an order of
angles to be reproduced, not reproduced, or not told.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from graderd.evaluation import study
from graderd.evaluation.page import COLORS, DEFINITIONS, STYLE, WITHOUT_CARRIED, number, title_of
from graderd.evaluation.statistics import Row, differences_of
from graderd.studies.blade_rotation import case as named
from graderd.studies.blade_rotation import matrix, rule
from graderd.studies.blade_rotation.case import Case
from graderd.studies.blade_rotation.contact import SOIL_SOIL, SOIL_TOOL
from graderd.studies.blade_rotation.matrix import AGAIN, HEIGHT, LOAD, SPREAD, Line, Table
from graderd.studies.blade_rotation.outcome import RULES, grid_over, surface
from graderd.studies.blade_rotation.store import Result, Store, written

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Picture = npt.NDArray[np.uint8]
PAGE, RESULTS = "index.html", "results.parquet"
TITLE = "The study behind the rotation rule, computed again"
WIDER = "body { max-width: 80rem; } th, td { padding: .28rem .35rem; } pre { white-space: pre-wrap; }"
ORDERS = {True: "reproduced", False: "not reproduced", None: "the intervals do not tell"}
HEIGHT_MAX_MM = 200.0
SHOWN = (SPREAD, "spread_mass_95_mm", "spread_second_moment_mm", HEIGHT, LOAD, "blade_load_max_n")
ANIMATED_N = 16


def write(store: Store) -> Path:
    """Write the page and ``results.parquet`` into the store's folder.

    Raises:
        StudyError: there are no results.
    """
    results = store.results()
    derived = rule.derive(results)
    size = _size(results)
    found = matrix.table(matrix.lines(size), results)
    found.lines[:] = [line for line in found.lines if any(row.case == line.name for row in found.rows)]
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        f"<title>{TITLE}</title><style>{STYLE} {WIDER}</style><body><h1>{TITLE}</h1>",
        _summary(found, results),
        _parameters(),
        _tables(found),
        _plots(found, store, results),
        _pictures(found, store, results),
        _daemon(found),
        _errors(found, size),
        _other(results, found),
        f"<h2>The rule that follows</h2><p>What the daemon's configuration takes as its section; an angle that the "
        f"intervals do not carry stays the default, behind #.</p><pre>{escape(derived.toml())}</pre>",
        _checks(results),
        _assumptions(),
    ]
    page = store.folder / PAGE
    written(page, "\n".join(parts) + "\n</body></html>\n")
    _results_table(store.folder / RESULTS, results)
    return page


def text_rows(found: Table) -> list[tuple[str, ...]]:
    """The main measures for a terminal."""
    return [
        (
            row.case,
            f"{row.angle_deg:g}°",
            title_of(row.measure),
            number(row.value),
            _interval(row),
            str(row.trials_n),
            number(found.study_value(row)),
        )
        for row in found.rows
        if row.measure in (SPREAD, HEIGHT, LOAD)
    ]


def _size(results: Sequence[Result]) -> matrix.Size:
    """Quick or full, whichever more of is there."""
    keys = {result.key for result in results}
    return max(
        (matrix.QUICK, matrix.FULL),
        key=lambda size: sum(case.key() in keys for case in matrix.cases(matrix.lines(size))),
    )


def _summary(found: Table, results: Sequence[Result]) -> str:
    orders = found.orders()
    counted = {told: [name for name, order in orders.items() if order is told] for told in ORDERS}
    lines = "".join(
        f"<li>{ORDERS[told]}: {len(names)} of {len(orders)}" + (f" ({escape('; '.join(names))})" if names else "")
        for told, names in counted.items()
    )
    grains = sorted({result.case.grains_n for result in results})
    seeds = max((row.trials_n for row in found.rows), default=0)
    return (
        f"<p>{len(results)} runs of {grains[0]} to {grains[-1]} grains on {escape(results[0].engine)}; up to {seeds} "
        "seeds a cell. Intervals hold the mean over the seeds with 95 % (Student's t); angles are compared pair by "
        "pair by Games and Howell. Left and right are mirror images and computed once.</p>"
        f"<p>The study's order of the three angles, by the measure that it decides by:</p><ul>{lines}</ul>"
    )


def _parameters() -> str:
    given = study.data()
    table_1 = "".join(
        f"<tr><td>{escape(key.replace('_', ' '))}<td>{value:g}" for key, value in given["table_1"].items()
    )
    table_2 = given["table_2"]
    default = Case.model_fields
    rows = [
        ("shear modulus [Pa]", table_2["shear_modulus_pa"][0], default["shear_modulus_pa"].default),
        *(
            (f"{where}: {name.replace('_', ' ')}", table_2[where][name][0], value)
            for where, contact in (("soil_soil", SOIL_SOIL), ("soil_tool", SOIL_TOOL))
            for name, value in (
                ("restitution", contact.restitution),
                ("static_friction", contact.static_friction),
                ("rolling_friction", contact.rolling_friction),
            )
        ),
    ]
    body = "".join(f"<tr><td>{escape(name.replace('_', '-', 1))}<td>{said:g}<td>{used:g}" for name, said, used in rows)
    return (
        "<h2>Tables 1 and 2: what goes in</h2><div class=beside><div><p>Table 1 (multibody). Soil does not feel it; "
        f"the coupled machine does.</p><table><tr><th>parameter<th>study{table_1}</table></div>"
        "<div><p>Table 2 (grains).</p>"
        f"<table><tr><th>parameter<th>study<th>here{body}</table></div></div>"
    )


def _tables(found: Table) -> str:
    parts = []
    for title, quarter, note in (
        ("Table 3: the 4 m blade", False, "Beside the study's simulation."),
        (
            "Table 4: the field's 1 m blade",
            True,
            "Beside the study's field experiments, with its piles of section 3.3. Whether its degree of spread is a "
            "whole width it does not say.",
        ),
    ):
        body = ""
        for line in found.lines:
            if line.name.startswith("quarter") is not quarter or not line.study:
                continue
            for measure in SHOWN:
                group = [row for row in found.rows if (row.case, row.measure) == (line.name, measure)]
                for number_, row in enumerate(group):
                    order = "" if number_ else _order(found, line, measure)
                    body += _row(row, found.study_value(row), order)
        if body:
            names = (
                "case",
                "angle",
                "measure",
                "mean",
                "95 %",
                "seeds",
                "study",
                "deviation",
                "in it",
                "study's order",
            )
            head = "".join(f"<th>{name}" for name in names)
            parts.append(f"<h2>{title}</h2><p>{note} Deviation: mean less the study's value.</p>")
            parts.append(f"<div class=wide><table><tr>{head}{body}</table></div>")
    used = dict.fromkeys(row.measure for row in found.rows if row.measure in SHOWN)
    meanings = "".join(f"<li>{escape(title_of(measure))}: {escape(_meaning(measure))}" for measure in used)
    return "\n".join(parts) + f"<p>Measures, as <code>graderd evaluate</code> takes them:</p><ul>{meanings}</ul>"


def _order(found: Table, line: Line, measure: str) -> str:
    values = line.study.get(measure)
    if values is None:
        return ""
    if not matrix.claimed(measure, values):
        return "the study claims none"
    return ORDERS[found.order(line.name, measure)]


def _meaning(measure: str) -> str:
    return DEFINITIONS[measure.replace(WITHOUT_CARRIED, "_mm")].format(edge_mm=RULES.edge_mm)


def _row(row: Row, said: float | None, order: str) -> str:
    cells = [escape(row.case), f"{row.angle_deg:g}°", escape(title_of(row.measure))]
    inside = ""
    if said is not None and row.low is not None and row.high is not None:
        inside = "yes" if row.low <= said <= row.high else "no"
    deviation = "" if said is None else f"{row.value - said:+.1f}"
    if said is not None and row.measure != HEIGHT:
        deviation += f" ({(row.value / said - 1.0) * 100.0:+.0f} %)"
    text = "<tr>" + "".join(f"<td>{cell}" for cell in cells) + f"<td class=mean>{number(row.value)}<td>{_interval(row)}"
    return (
        text + f"<td>{row.trials_n}<td>{number(said) if said is not None else ''}<td>{deviation}<td>{inside}<td>{order}"
    )


def _interval(row: Row) -> str:
    return "–" if row.low is None else f"{number(row.low)} to {number(row.high)}"


def _plots(found: Table, store: Store, results: Sequence[Result]) -> str:
    """By angle with intervals; over the travel; along the blade."""
    shown = [line for line in found.lines if line.study and not line.name.startswith(("right", "quarter, right"))]
    scattered = [line for line in shown if line.order_by == SPREAD]
    keys = {result.key for result in results}

    def travelled(ax: Axes, cases: Sequence[Case], color: str) -> None:
        for number_, case in enumerate(cases):
            curve = store.table(case, "travel").to_pydict()
            width = [math.nan if value is None else value for value in curve[SPREAD]]
            label = None if number_ else f"{case.angle_deg:g}°"
            ax.plot(curve["travel_m"], width, color=color, linewidth=0.8, label=label)

    def loaded(ax: Axes, cases: Sequence[Case], color: str) -> None:
        mean = np.mean([np.mean(store.table(case, "along").to_pydict()["load_n"], axis=0) for case in cases], axis=0)
        place = ((np.arange(mean.size) + 0.5) / mean.size - 0.5) * cases[0].blade.length_m
        ax.plot(place, mean, color=color, drawstyle="steps-mid", label=f"{cases[0].angle_deg:g}°")

    parts = [_by_angle(found, shown)] if shown else []
    for draw, x_label, y_label, caption in (
        (travelled, "travel since contact [m]", "spread [mm]", "Degree of spread (extreme) if the pass ended there."),
        (loaded, "along the blade, left positive [m]", "load [N a part]", "Load along the blade, mean over the pass."),
    ):
        if not scattered:
            continue
        figure, axes = _axes(len(scattered))
        for line, ax in zip(scattered, axes, strict=False):
            for angle, color in zip(line.angles_deg, COLORS, strict=False):
                cases = [case for case in line.cases() if case.angle_deg == angle and case.key() in keys]
                if cases:
                    draw(ax, cases, color)
            ax.set_title(line.name, fontsize=9)
            ax.set_xlabel(x_label, fontsize=7)
            ax.set_ylabel(y_label, fontsize=7)
            ax.legend(fontsize=7)
        parts.append(_figure(figure, caption))
    return "<h2>Plots</h2>" + "\n".join(parts) if parts else ""


def _axes(count: int) -> tuple[Figure, list[Axes]]:
    """So many plots, four a row."""
    from matplotlib.figure import Figure

    rows = math.ceil(count / 4)
    figure = Figure(figsize=(11.0, 2.7 * rows), layout="constrained")
    axes = list(figure.subplots(rows, 4, squeeze=False).flat)
    for ax in axes[count:]:
        ax.set_axis_off()
    for ax in axes:
        ax.tick_params(labelsize=7)
    return figure, axes


def _by_angle(found: Table, shown: Sequence[Line]) -> str:
    figure, axes = _axes(len(shown))
    for line, ax in zip(shown, axes, strict=False):
        for row in found.rows:
            if (row.case, row.measure) != (line.name, line.order_by):
                continue
            ax.plot([row.angle_deg] * row.trials_n, row.values, "o", color=COLORS[0], alpha=0.35, markersize=4)
            if row.low is not None and row.high is not None:
                reach = [[row.value - row.low], [row.high - row.value]]
                ax.errorbar(row.angle_deg, row.value, reach, color=COLORS[0], fmt="s")
        ax.plot(line.angles_deg, line.study[line.order_by], "x--", color=COLORS[1])
        ax.set_title(line.name, fontsize=9)
        ax.set_ylabel(title_of(line.order_by), fontsize=7)
        ax.set_xticks(line.angles_deg)
    return _figure(figure, "By angle: dots are runs, squares means with their intervals, crosses the study's values.")


def _pictures(found: Table, store: Store, results: Sequence[Result]) -> str:
    """Before and after from above, as the study's Fig. 2; one pass as it goes."""
    keys = {result.key for result in results}
    parts = [
        "<h2>The soil before and after, from above</h2><p>Forward up, left on the left; brighter is higher, white the "
        "blade's face. Seed 1.</p><div class=maps>"
    ]
    for line in found.lines:
        if line.name.startswith(("right", "quarter, right")) or not line.study:
            continue
        for angle in line.angles_deg:
            case = line.case.model_copy(update={"angle_deg": angle, "seed": 1})
            if case.key() in keys:
                pictures = [_above(store, case, at) for at in (0, -1)]
                images = "".join(
                    f"<img src='{_png(picture)}' width=150 alt='' style='display:inline-block'>" for picture in pictures
                )
                parts.append(f"<figure>{images}<figcaption>{escape(line.name)}, {angle:g}°</figcaption></figure>")
    parts.append("</div>")
    biggest = max(
        results, key=lambda result: (result.case.work != "flattening", result.case.grains_n, -result.case.angle_deg)
    )
    case = biggest.case
    frames_n = store.table(case, "frames").num_rows
    at = np.unique(np.linspace(0, frames_n - 1, ANIMATED_N).round().astype(int))
    pictures = [_above(store, case, int(number)) for number in at]
    parts.append(
        f"<h2>A pass</h2><figure><img src='{_animation(pictures)}' width=420 alt='animation of one pass'>"
        f"<figcaption>{escape(case.work)}, {case.angle_deg:g}° {escape(case.sense)}, {case.grains_n} grains"
        "</figcaption></figure>"
    )
    return "\n".join(parts)


def _above(store: Store, case: Case, at: int) -> Picture:
    """One frame from above as a picture, blue, green, red; all frames of a case show the same part of the floor."""
    import pyarrow.compute as pc

    canonical = case.canonical
    soil, frames = store.table(canonical, "soil"), store.table(canonical, "frames").to_pylist()
    at %= len(frames)
    columns = [np.asarray(soil[name]) for name in ("x", "y", "z", "radius")]
    low = [float(each.min()) - 0.2 for each in columns[:2]]
    high = [float(each.max()) + 0.2 for each in columns[:2]]
    own = soil.filter(pc.equal(soil["frame"], at))
    grains = np.column_stack((np.zeros(own.num_rows), *(np.asarray(own[name]) for name in ("x", "y", "z", "radius"))))
    grid = grid_over(grains)
    heights = surface(grains, grid)
    cell_m = grid.cell_mm / 1000.0
    shape = [math.ceil((b - a) / cell_m) for a, b in zip(low, high, strict=True)]
    whole = np.zeros(shape)
    i0, j0 = (round(first - start / cell_m) for first, start in zip((grid.first_x, grid.first_y), low, strict=True))
    i1, j1 = max(0, i0), max(0, j0)
    part = heights[i1 - i0 : shape[0] - i0, j1 - j0 : shape[1] - j0]
    whole[i1 : i1 + part.shape[0], j1 : j1 + part.shape[1]] = part
    share = np.clip(whole / HEIGHT_MAX_MM, 0.0, 1.0)
    grey = (share[::-1, ::-1] * 255).astype(np.uint8)
    picture: Picture = np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_CIVIDIS), dtype=np.uint8)
    frame, half = frames[at], canonical.blade.length_m / 2.0
    ends = []
    for side in (-half, half):
        x = frame["x"] - side * math.sin(frame["yaw_rad"])
        y = frame["y"] + side * math.cos(frame["yaw_rad"])
        ends.append((shape[1] - 1 - round((y - low[1]) / cell_m), shape[0] - 1 - round((x - low[0]) / cell_m)))
    cv2.line(picture, ends[0], ends[1], (255, 255, 255), 2)
    return picture


def _daemon(found: Table) -> str:
    """The decision held for the pass, against decided again in the midst of it."""
    body = ""
    for line in found.lines:
        if not line.name.endswith(AGAIN):
            continue
        held = line.name.removesuffix(f", {AGAIN}")
        for measure in (SPREAD, LOAD):
            pair = [
                next(
                    (
                        row
                        for row in found.rows
                        if (row.case, row.angle_deg, row.measure) == (name, line.angles_deg[0], measure)
                    ),
                    None,
                )
                for name in (held, line.name)
            ]
            if pair[0] is not None and pair[1] is not None:
                body += _compared(f"{held}, {line.angles_deg[0]:g}°", measure, pair[0], pair[1])
    if not body:
        return ""
    return (
        "<h2>The daemon's behaviour</h2><p>One decision a pass, against a second one in mid-pass from what the blade "
        "then carries (the daemon's rule, thirds and swing). Difference: again less held.</p>"
        f"<table><tr><th>case<th>measure<th>held<th>again<th>difference<th>95 %{body}</table>"
    )


def _compared(name: str, measure: str, one: Row, other: Row) -> str:
    """One row of a table of two things compared, by Games and Howell, which for two is Welch's test."""
    rows = [_renamed(one, 0.0), _renamed(other, 1.0)]
    tested = differences_of(rows, matrix.CONFIDENCE)
    sure = "–"
    if tested:
        pair = tested[0].pairs[0]
        sure = f"{number(-pair.high)} to {number(-pair.low)}"
    return (
        f"<tr><td>{escape(name)}<td>{escape(title_of(measure))}<td>{number(one.value)}<td>{number(other.value)}"
        f"<td>{other.value - one.value:+.1f} ({(other.value / one.value - 1.0) * 100.0:+.1f} %)<td>{sure}"
    )


def _renamed(row: Row, angle_deg: float) -> Row:
    return Row("", angle_deg, row.measure, row.values, row.value, row.deviation, row.low, row.high)


def _errors(found: Table, size: matrix.Size) -> str:
    """What coarse grains and the time step do to the measures."""
    body, angle = "", matrix.ERROR_ANGLE_DEG
    for name in matrix.errors(size):
        for measure in (SPREAD, "spread_mass_95_mm", LOAD):
            pair = [
                next(
                    (row for row in found.rows if (row.case, row.angle_deg, row.measure) == (case, angle, measure)),
                    None,
                )
                for case in ("middle", f"middle, {name}")
            ]
            if pair[0] is not None and pair[1] is not None:
                body += _compared(f"middle, {angle:g}°: {name}", measure, pair[0], pair[1])
    if not body:
        return ""
    line = next(line for line in matrix.lines(size) if line.name == "middle")
    coarse = line.case.pile.coarse_graining(line.case.grains_n)
    return (
        f"<h2>Error of the method</h2><p>The tables' runs stand for the study's grains by grains {coarse:.1f} times as "
        "wide. Against them, the same with coarser and finer grains and with half the time step.</p>"
        f"<table><tr><th>case<th>measure<th>tables<th>other<th>difference<th>95 %{body}</table>"
    )


def _other(results: Sequence[Result], found: Table) -> str:
    """Runs of the store that no table has: full cases, sweeps, coupled runs."""
    shown = {case.key() for line in found.lines for case in line.cases()}
    others = [result for result in results if result.key not in shown]
    if not others:
        return ""
    body = "".join(
        f"<tr><td>{escape(result.case.work)}<td>{result.case.angle_ccw_deg:+g}°<td>{result.case.grains_n}<td>{result.case.seed}"
        f"<td>{_changed(result.case)}<td>{number(result.measures.get(SPREAD, result.measures.get(HEIGHT)))}"
        f"<td>{number(result.measures[LOAD])}<td>{result.particle_steps_n:.2g}"
        for result in sorted(others, key=lambda result: -result.case.grains_n)[:60]
    )
    head = "<th>soil<th>angle, ccw<th>grains<th>seed<th>else<th>spread or height [mm]<th>load [N]<th>particle-steps"
    return (
        "<h2>Other runs</h2><p>Single ones: no interval, and so nothing to conclude by themselves.</p>"
        f"<div class=wide><table><tr>{head}{body}</table></div>"
    )


def _changed(case: Case) -> str:
    names = (
        "gap_m",
        "travel_m",
        "friction",
        "rolling_friction",
        "floor",
        "step_of_rayleigh",
        "decision",
        "motion",
        "offset_share",
    )
    told = [f"{name} {getattr(case, name)}" for name in names if getattr(case, name) != Case.model_fields[name].default]
    if case.blade != named.FULL_SIZE:
        told.append(f"blade {case.blade.length_m:g} m")
    return escape(", ".join(told))


def _checks(results: Sequence[Result]) -> str:
    worst = {name: max(result.checks[name] for result in results) for name in results[0].checks}
    speeds = sorted(result.particle_steps_n / result.engine_s for result in results if result.engine_s > 1.0)
    speed = f"{speeds[len(speeds) // 2] / 1e6:.2f}" if speeds else "–"
    return (
        "<h2>What must hold</h2><ul>"
        f"<li>grains lost in any run: {worst['grains_lost_n']:.0f}"
        "<li>the soil's momentum along the travel less what blade and floor gave it: at most "
        f"{worst['momentum_share']:.1%} of the blade's push"
        f"<li>energy from nowhere between two frames: at most {worst['gained_share']:.2%} of the blade's work"
        f"<li>fastest grain {worst['pace_max_m_per_s']:.1f} m/s; neighbour lists made too late, by the engine's count: "
        f"{worst['dangerous_builds_n']:.0f}<li>median speed: {speed} million particle-steps a second and run</ul>"
    )


def _assumptions() -> str:
    fields = {
        "blade": named.FULL_SIZE.model_dump(), "offset_share": matrix.OFFSET_SHARE, "packing": named.PACKING,
    }  # fmt: skip
    told = "".join(f"<li><code>{escape(name)}</code> = {escape(str(value))}" for name, value in fields.items())
    for name in ("gap_m", "travel_m", "speed_m_per_s", "floor", "step_of_rayleigh"):
        told += f"<li><code>{name}</code> = {Case.model_fields[name].default} unless the table's line says otherwise"
    return (
        "<h2>What the study leaves open</h2><p>Size of the grains, place and shape of the pile, height and curvature "
        "of the blade, its gap to the floor, the travel until the spread is measured, and which way the blade is "
        "turned are not printed. They are inputs of a case here (<code>studies/blade_rotation/case.py</code> has the "
        f"reason for each default):</p><ul>{told}</ul>"
    )


def _results_table(path: Path, results: Iterable[Result]) -> None:
    """One row a run: its hash, its case, its measures and checks."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = []
    for result in results:
        case = result.case.model_dump(mode="json")
        flat = {f"{name}.{key}": value for name in ("blade", "pile") for key, value in case.pop(name).items()}
        rows.append({"key": result.key, **case, **flat, **result.measures, **result.checks})
    names = list(dict.fromkeys(name for row in rows for name in row))
    pq.write_table(pa.table({name: [row.get(name) for row in rows] for name in names}), path)


def _figure(figure: Figure, caption: str) -> str:
    out = io.StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    text = out.getvalue()
    return f"<figure>{text[text.index('<svg') :]}<figcaption>{escape(caption)}</figcaption></figure>"


def _png(picture: Picture) -> str:

    _, png = cv2.imencode(".png", picture)
    return "data:image/png;base64," + base64.b64encode(png.tobytes()).decode("ascii")


def _animation(pictures: Sequence[Picture]) -> str:
    from PIL import Image

    images = [Image.fromarray(picture[:, :, ::-1]) for picture in pictures]
    out = io.BytesIO()
    images[0].save(out, "WEBP", save_all=True, append_images=images[1:], duration=150, loop=0, quality=70)
    return "data:image/webp;base64," + base64.b64encode(out.getvalue()).decode("ascii")
