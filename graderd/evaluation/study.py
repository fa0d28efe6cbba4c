"""The study's own numbers (Tables 1 to 4, as data) and what becomes of them when they are computed again.

*Strategy for Motor Grader Blade Rotation considering Soil Distribution*. Every number that others in the study
determine is recomputed; :func:`findings` says of each whether it adds up.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from graderd.evaluation import experiment
from graderd.evaluation.statistics import Difference, Row, differences_of, rows_of
from graderd.evaluation.trial import evaluate_trials

ANGLES_DEG = (15, 30, 45)
CASES = {
    "flattening": "Flattening work",
    "left": "Scattering work (soil on left side)",
    "middle": "Scattering work (soil on middle side)",
}
MEASURES = {"flattening": "height_difference_mm", "left": "spread_mm", "middle": "spread_mm"}
ABOUT_POINTS = 1.0
""""About 15 %" may be a percentage point off; a figure without "about" is right as it is rounded."""


class Verdict(StrEnum):
    """What a stated number is worth."""

    ADDS_UP = "adds up"
    IN_PART = "in part"
    DOES_NOT = "does not add up"
    UNCLEAR = "cannot be told"


@dataclass(frozen=True, slots=True)
class Finding:
    """One number or sentence: where it stands, what it says, what its own data give, and the verdict."""

    where: str
    says: str
    gives: str
    verdict: Verdict


def data() -> dict[str, Any]:
    """Tables 1 to 3 and the numbers of the text, as printed."""
    return tomllib.loads(files(__package__).joinpath("study.toml").read_text(encoding="utf-8"))


def table_4_path() -> Path:
    """Table 4 as an experiment file: ``graderd evaluate`` takes it like any other."""
    return Path(str(files(__package__).joinpath("table_4.toml")))


@dataclass(frozen=True, slots=True)
class Study:
    """The data and Table 4 evaluated."""

    given: dict[str, Any]
    rows: tuple[Row, ...]
    differences: tuple[Difference, ...]

    def row(self, case: str, angle_deg: float) -> Row:
        """A row of Table 4."""
        return next(row for row in self.rows if (row.case, row.angle_deg) == (CASES[case], angle_deg))

    def field(self, case: str) -> list[float]:
        """Table 4's means at the three angles."""
        return [self.row(case, angle).value for angle in ANGLES_DEG]

    def simulated(self, case: str) -> list[float]:
        """Table 3's at the three angles."""
        return list(self.given["table_3"][case][MEASURES[case]])

    def p(self, case: str, angle_deg: float, other_deg: float) -> float:
        """Games-Howell's p of a pair."""
        whole = next(each for each in self.differences if each.case == CASES[case])
        return next(pair.p for pair in whole.pairs if {pair.angle_deg, pair.other_deg} == {angle_deg, other_deg})


@cache
def evaluated() -> Study:
    """The shipped data, evaluated."""
    path = table_4_path()
    read = experiment.load(path)
    level = read.confidence_percent / 100.0
    rows = rows_of(evaluate_trials(read, path.parent), level)
    return Study(data(), tuple(rows), tuple(differences_of(rows, level)))


def findings(study: Study) -> list[Finding]:
    """Every number that can be checked, in the study's order."""
    parts: tuple[Callable[[Study], list[Finding]], ...] = (
        _parameters,
        _simulation,
        _set_up,
        _averages,
        _field_claims,
        _comparison,
    )
    return [finding for part in parts for finding in part(study)]


def wider_percent(value: float, base: float) -> float:
    """How much wider than ``base``."""
    return (value / base - 1.0) * 100.0


def _judged(stated: float, found: float, tolerance: float) -> Verdict:
    return Verdict.ADDS_UP if abs(stated - found) <= tolerance else Verdict.DOES_NOT


def _parameters(study: Study) -> list[Finding]:
    given = study.given
    table, text, soil, tool = (
        given["table_1"],
        given["text"]["mbd"],
        given["table_2"]["soil_soil"],
        given["table_2"]["soil_tool"],
    )
    same = [value for key, value in table.items()] == list(text.values())
    young_pa = 2.0 * given["table_2"]["shear_modulus_pa"][0] * (1.0 + given["table_2"]["poisson_ratio"][0])
    threshold, speed = table["static_threshold_velocity_m_per_s"], given["text"]["simulated_speed_m_per_s"]
    return [
        Finding(
            "Table 1, section 2.1",
            "five contact parameters, twice",
            "the same in table and text; stiffness and damping have no unit in either",
            Verdict.ADDS_UP if same else Verdict.DOES_NOT,
        ),
        Finding(
            "Table 1",
            f"static threshold velocity {threshold:g} m/s, blade speed {speed:g} m/s",
            "soil that slides along the blade stays at or below the threshold, so that friction hardly ever becomes "
            "sliding "
            "friction; meant in mm/s, it would",
            Verdict.UNCLEAR,
        ),
        Finding(
            "Tables 1 and 2",
            f"static friction {table['static_friction_coefficient']} (MBD), {tool['static_friction'][0]} (soil-tool)",
            "the same",
            Verdict.ADDS_UP if table["static_friction_coefficient"] == tool["static_friction"][0] else Verdict.DOES_NOT,
        ),
        Finding(
            "Table 2, section 2.2",
            "Young's modulus is said to be set, and is not listed",
            f"2G(1 + ν) = {young_pa / 1e6:.1f} MPa from shear modulus and Poisson's ratio",
            Verdict.ADDS_UP,
        ),
        Finding(
            "Table 2, section 2.2",
            "all values from [18]",
            f"the table names [14] to [18]; rolling friction {soil['rolling_friction'][0]} between grains exceeds "
            "static "
            f"friction {soil['static_friction'][0]}; grain size, which decides what a number of grains is, is not "
            "given",
            Verdict.IN_PART,
        ),
    ]


def _simulation(study: Study) -> list[Finding]:
    flat, left, middle = (study.given["table_3"][name] for name in CASES)
    heights, loads = flat["height_difference_mm"], flat["blade_load_n"]
    found = [
        Finding(
            "2.5, flattening",
            "work quality is similar at all three angles",
            f"{min(heights):g} to {max(heights):g} mm: {max(heights) - min(heights):.1f} mm apart",
            Verdict.ADDS_UP,
        ),
        Finding(
            "2.5, flattening",
            "less load as the angle increases",
            f"{loads[0]:g}, {loads[1]:g}, {loads[2]:g} N: {-wider_percent(loads[2], loads[0]):.1f} % less at 45° "
            "than at 15°",
            Verdict.ADDS_UP if loads[0] > loads[1] > loads[2] else Verdict.DOES_NOT,
        ),
        _better("2.5, soil on the left", 15.0, 30, left["spread_mm"]),
        _better("2.5, soil in the middle", 10.0, 15, middle["spread_mm"]),
    ]
    for name, part in (("on the left", left), ("in the middle", middle)):
        load = part["blade_load_n"]
        apart = wider_percent(max(load), min(load))
        verdict = Verdict.ADDS_UP if apart < 2.0 else Verdict.IN_PART
        gives = f"{min(load):g} to {max(load):g} N: {apart:.1f} % apart" + (
            "" if apart < 2.0 else ", falling with the angle as in flattening"
        )
        found.append(Finding(f"2.5, soil {name}", "stability is similar at all three angles", gives, verdict))
    return found


def _better(where: str, stated: float, best_deg: int, values: Sequence[float]) -> Finding:
    """ "Good by about N % compared to the rest"."""
    best = values[ANGLES_DEG.index(best_deg)]
    rest = {
        angle: wider_percent(best, value) for angle, value in zip(ANGLES_DEG, values, strict=True) if angle != best_deg
    }
    mean = wider_percent(best, float(np.mean([v for a, v in zip(ANGLES_DEG, values, strict=True) if a != best_deg])))
    close = [_judged(stated, each, ABOUT_POINTS) is Verdict.ADDS_UP for each in rest.values()]
    verdict = Verdict.ADDS_UP if all(close) else Verdict.IN_PART if any(close) else Verdict.DOES_NOT
    if best != max(values):
        verdict = Verdict.DOES_NOT
    gives = " and ".join(f"{each:.1f} % against {angle}°" for angle, each in rest.items())
    return Finding(
        where,
        f"{best_deg}° is best, by about {stated:g} % compared to the rest",
        f"{gives}; {mean:.1f} % against the mean of both",
        verdict,
    )


def _set_up(study: Study) -> list[Finding]:
    text = study.given["text"]
    ratio = text["simulated_blade_m"] / text["field_blade_m"]
    same_froude = text["simulated_speed_m_per_s"] / math.sqrt(ratio)
    flat, heap = (math.prod(text[name]) for name in ("pile_flattening_m", "pile_scattering_m"))
    grains = text["particles_flattening_n"] / text["particles_scattering_n"]
    views, apart = [], []
    for name, (wide, high), size in (
        ("colour", text["color_view_deg"], text["color_px"]),
        ("depth", text["depth_view_deg"], (848, 480)),
    ):
        of_angles = math.tan(math.radians(wide / 2)) / math.tan(math.radians(high / 2))
        apart.append(abs(of_angles / (size[0] / size[1]) - 1.0))
        views.append(f"{name} {of_angles:.2f} from the angles, {size[0] / size[1]:.2f} from {size[0]} x {size[1]}")
    return [
        Finding(
            "2.1, 3.1",
            f"1/{text['scale']} scale, blade {text['simulated_blade_m']} m and {text['field_blade_m']} m",
            f"{ratio:g}",
            _judged(text["scale"], ratio, 0.0),
        ),
        Finding(
            "3.3",
            f"{text['field_speed_m_per_s']} m/s, the same speed as in the simulation",
            f"the same number; alike in the ratio of inertia to gravity (Froude) at a length of 1/{text['scale']} it "
            "would be "
            f"{same_froude:g} m/s",
            Verdict.IN_PART,
        ),
        Finding(
            "2.4, 3.3",
            "both tasks' environment is identical to the simulation's",
            f"piles of {flat:.3f} and {heap:.3f} m³ as boxes, {flat / heap:.1f} to 1; grains "
            f"{text['particles_flattening_n']:,} and {text['particles_scattering_n']:,}, {grains:.1f} to 1",
            _judged(flat / heap, grains, 0.1),
        ),
        Finding(
            "3.2",
            "fields of view and frame size of the D455",
            "width to height: " + "; ".join(views),
            Verdict.ADDS_UP if max(apart) < 0.05 else Verdict.DOES_NOT,
        ),
        Finding(
            "3.1",
            f"servo: {text['servo_torque_nm']} Nm, at most {text['servo_speed_rpm']} rpm",
            "the maker's continuous torque and continuous speed (PH54-200-S500-R); unloaded it turns at 33.1 rpm",
            Verdict.IN_PART,
        ),
    ]


def _averages(study: Study) -> list[Finding]:
    found = []
    for case, title in CASES.items():
        for angle, stated in zip(ANGLES_DEG, study.given["table_4_averages"][case], strict=True):
            row = study.row(case, angle)
            found.append(
                Finding(
                    f"Table 4, {title}",
                    f"{angle}°: average {stated:g} mm",
                    f"{row.value:.2f} mm",
                    _judged(stated, row.value, 0.05 + 1e-9),
                )
            )
    printed = study.given["table_4_averages"]
    same = all(study.given["text"]["averages_mm"][case] == printed[case] for case in ("left", "middle"))
    found.append(
        Finding(
            "4.1",
            "the six averages of spread once more",
            "the same as in Table 4",
            Verdict.ADDS_UP if same else Verdict.DOES_NOT,
        )
    )
    return found


def _field_claims(study: Study) -> list[Finding]:
    left, middle, flat = (study.field(case) for case in ("left", "middle", "flattening"))
    # From the averages as printed, as the study did.
    against = [
        wider_percent(study.given["table_4_averages"]["left"][1], base)
        for base in study.given["table_4_averages"]["left"]
    ]
    wider = wider_percent(*(study.given["table_4_averages"]["middle"][at] for at in (0, 2)))
    off = [study.row("flattening", angle) for angle in ANGLES_DEG]
    below = all(row.high is not None and row.high < 0.0 for row in off)
    pile_mm = study.given["text"]["pile_scattering_m"][1] * 1000.0
    narrower = sum(value < pile_mm for row in study.rows if row.measure == "spread_mm" for value in row.values)
    total = sum(row.trials_n for row in study.rows if row.measure == "spread_mm")
    means = ", ".join(f"{value:.1f}" for value in flat)
    return [
        Finding(
            "4.1, flattening",
            "almost consistent with the target",
            f"means {means} mm: "
            + ("below the target at every angle, zero outside each 95 % interval" if below else "about 0"),
            Verdict.IN_PART,
        ),
        Finding(
            "4.1, soil on the left",
            "16 % wider than at the basic working angle of 45°",
            f"{against[2]:.1f} % against 45° ({left[2]:.1f} mm); 16 % is against 15° ({left[0]:.1f} mm): "
            f"{against[0]:.1f} %",
            _judged(16.0, against[2], 0.5),
        ),
        Finding(
            "4.1, soil in the middle",
            "10 % wider than at the basic working angle of 45°",
            f"{wider:.1f} %",
            _judged(10.0, wider, 0.5),
        ),
        Finding(
            "4.1",
            "30° is the most efficient with soil left, 15° with soil in the middle",
            f"yes, and not by chance: p of the nearest rival {_p(study.p('left', 30, 45))} (left), "
            f"{_p(study.p('middle', 15, 30))} (middle)",
            Verdict.ADDS_UP if left[1] == max(left) and middle[0] == max(middle) else Verdict.DOES_NOT,
        ),
        Finding(
            "3.3, Table 4",
            "degree of spread, by measuring the left and right distances of the soil",
            f"the pile was {pile_mm:g} mm wide before the pass; {narrower} of {total} values are less, so that they "
            "can "
            "hardly be whole widths. Mean of the left and the right distance (half the width) would fit; the text "
            "does not say",
            Verdict.UNCLEAR,
        ),
        Finding(
            "5",
            "soil on one side: approximately 16 % better with the algorithm",
            f"{against[2]:.1f} % against 45°, {against[0]:.1f} % against 15°",
            _judged(16.0, against[2], ABOUT_POINTS),
        ),
        Finding(
            "5", "soil in the center: approximately 10 % wider", f"{wider:.1f} %", _judged(10.0, wider, ABOUT_POINTS)
        ),
        Finding(
            "5",
            "flattening showed a similar stability at each angle",
            "no load was measured in the field (Table 4), and Table 3 has it fall by "
            f"{-wider_percent(*reversed(study.given['table_3']['flattening']['blade_load_n'][::2])):.1f} % from 15° "
            "to 45°, "
            "which section 2.5 takes for the reason to choose 45°",
            Verdict.DOES_NOT,
        ),
    ]


def _comparison(study: Study) -> list[Finding]:
    ratios = [
        s / f for case in ("left", "middle") for s, f in zip(study.simulated(case), study.field(case), strict=True)
    ]
    scale = study.given["text"]["scale"]
    flat, simulated = study.field("flattening"), study.simulated("flattening")
    ranks = [[ANGLES_DEG[at] for at in np.argsort(np.abs(values))] for values in (simulated, flat)]
    pairs = [study.p("flattening", 30, other) for other in (15, 45)]
    field_range, simulated_range = (max(values) - min(values) for values in (flat, simulated))
    return [
        Finding(
            "4.1, spread",
            "field results similar to the simulation's",
            f"simulation to field {min(ratios):.2f} to {max(ratios):.2f}, the scale of {scale} within "
            f"{max(abs(ratio / scale - 1) for ratio in ratios) * 100:.1f} %, in the same order of angles",
            Verdict.ADDS_UP if all(abs(ratio / scale - 1) < 0.05 for ratio in ratios) else Verdict.DOES_NOT,
        ),
        Finding(
            "4.1, flattening",
            "consistent with the simulation results",
            f"best to worst: {', '.join(f'{a}°' for a in ranks[0])} simulated, "
            f"{', '.join(f'{a}°' for a in ranks[1])} in the "
            f"field. The angles differ by {field_range:.1f} mm in the field (30° from each other one: p "
            f"{_p(max(pairs))} or "
            f"less), by {simulated_range:.1f} mm in a simulation four times as large",
            Verdict.DOES_NOT if ranks[0] != ranks[1] else Verdict.ADDS_UP,
        ),
    ]


def _p(value: float) -> str:
    return f"{value:.1g}" if value < 0.001 else f"{value:.3f}"


def page(study: Study) -> str:
    """The page of the documentation, in Markdown."""
    every = findings(study)
    counted = {verdict: sum(each.verdict is verdict for each in every) for verdict in Verdict}
    lines = [
        "# The study's numbers, computed again\n",
        "Tables 1 to 4 of *Strategy for Motor Grader Blade Rotation considering Soil Distribution* ship as data "
        "(`graderd/evaluation/study.toml`, `table_4.toml`). `graderd evaluate --study` computes this page's tables "
        "again, from "
        "these data and by the code that evaluates every other experiment.\n",
        f"Of {len(every)} numbers and statements, {counted[Verdict.ADDS_UP]} add up, {counted[Verdict.IN_PART]} do "
        "in part, "
        f"{counted[Verdict.DOES_NOT]} do not, and of {counted[Verdict.UNCLEAR]} it cannot be told. That the blade at "
        "30° spreads "
        "soil on the left widest, and at 15° soil in the middle, stands. By how much is told wrongly for the left: "
        "13.2 % "
        "against the basic working angle of 45°, not 16 %.\n",
        "## Statement by statement\n",
        "| where | it says | its own data give | |\n|---|---|---|---|",
    ]
    lines += [f"| {each.where} | {each.says} | {each.gives} | {_marked(each.verdict)} |" for each in every]
    lines += [
        "\nA percentage counts as right as it is rounded, or within one point where the study says about or "
        "approximately.\n",
        "## Table 4 once more\n",
        "| case | angle | mean [mm] | standard deviation | 95 % interval | trials |\n|---|---|---|---|---|---|",
    ]
    for row in study.rows:
        assert row.deviation is not None  # five trials each
        assert row.low is not None
        assert row.high is not None
        lines.append(
            f"| {row.case} | {row.angle_deg:g}° | {row.value:.2f} | {row.deviation:.2f} | {row.low:.2f} to "
            f"{row.high:.2f} "
            f"| {row.trials_n} |"
        )
    lines += [
        "\n## Do the angles differ?\n",
        "Welch's analysis of variance over the three angles, then every pair by Games and Howell, which adjusts p "
        "and interval "
        "for the number of pairs. Five trials each; neither asks for equal scatter.\n",
        "| case | angles | difference [mm] | 95 % interval | in % of the second | p |\n|---|---|---|---|---|---|",
    ]
    for whole in study.differences:
        lines.append(f"| {whole.case} | all | | F = {whole.f:.1f} | | {_p(whole.p)} |")
        for pair in whole.pairs:
            base = next(r.value for r in study.rows if (r.case, r.angle_deg) == (whole.case, pair.other_deg))
            percent = f"{pair.difference / base * 100:+.1f}" if base > 0 else ""
            lines.append(
                f"| {whole.case} | {pair.angle_deg:g}° less {pair.other_deg:g}° | {pair.difference:+.2f} "
                f"| {pair.low:+.2f} to {pair.high:+.2f} | {percent} | {_p(pair.p)} |"
            )
    return "\n".join(lines) + "\n"


def _marked(verdict: Verdict) -> str:
    return f"**{verdict}**" if verdict is Verdict.DOES_NOT else str(verdict)
