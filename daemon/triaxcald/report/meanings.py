"""What an effect is, in words and as a formula, by the names that stand in the documents.

``e`` is what the effect adds to the reading of one axis, in the unit of the reference vector: u = K (s + b + e), where
s is the specific force along that sensitive axis. An effect that is not listed here, as one of somebody else's package,
is shown by its name and its coefficients alone.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from triaxcal.effects.contract import RUN, covariate_of
from triaxcald.report.figures import clean, digits, effect_title, power

_ALONE = "{by}, in recording {n} alone"
_AGAINST_FIRST = "{by} in recording {n}, −{by} in recording 1"


@dataclass(frozen=True)
class Meaning:
    """``clause`` says it in a clause, ``because`` what usually makes it; ``factors`` what a coefficient is multiplied
    by, by its name with ``*`` in place of the axis; ``symbols`` what the letters mean. ``{c}`` is the channel.
    ``in_run`` says what a coefficient of recording ``{n}`` is multiplied by where ``{by}`` is that of a single one.
    """

    clause: str
    because: str
    formula: str
    factors: Mapping[str, str]
    symbols: str = ""
    reference: tuple[str, str] | None = None
    """A letter of the formula and the channel whose reference it is."""
    in_run: str = _ALONE


@dataclass(frozen=True)
class Told:
    """A meaning of one effect of a document, with its channel and its references put in."""

    title: str
    clause: str
    because: str
    formula: str
    symbols: str


_T = ("T₀", "temp_c")
_C = ("c₀", "{c}")
_OF_RUNS = "q: one for each recording, their sum zero; where one recording alone differs, zero in the others"
_MEANINGS = {
    "second_order_nonlinearity": Meaning(
        "the output bends with the square of the input",
        "The sensing element or its amplifier is not quite straight; the unit keeps it.",
        "e = q s²", {"*": "s²"},
    ),
    "third_order_nonlinearity": Meaning(
        "the output bends with the cube of the input",
        "The sensing element or its amplifier flattens towards both ends of its range; the unit keeps it.",
        "e = q s³", {"*": "s³"},
    ),
    "fifth_order_nonlinearity": Meaning(
        "the output bends with the fifth power of the input",
        "The sensing element or its amplifier flattens towards both ends of its range, more steeply than a cube; the "
        "unit keeps it.",
        "e = q s⁵", {"*": "s⁵"},
    ),
    "compression": Meaning(
        "the output gives way towards the ends of the range",
        "An amplifier nears its supply, or a torquer the end of its current; the unit keeps it.",
        "e = −q (h(s) − h(−s))  or  e = −q (h(s) + h(−s))",
        {"*": "h(−s) − h(s)", "even_*": "−h(s) − h(−s)", "knee": "κ"},
        "h(s): s − κ beyond the knee κ and zero below it, with a bend as wide as κ/10 between",
    ),
    "scale_factor_asymmetry": Meaning(
        "the scale factor differs between positive and negative inputs",
        "The two halves of a push-pull stage or of a differential element are unlike; the unit keeps it.",
        "e = q |s|", {"*": "|s|"},
    ),
    "cross_coupling": Meaning(
        "what one axis reads depends on the product of two components",
        "A proof mass that moves along one axis changes how it answers along another; the unit keeps it.",
        "e = qⱼ s sⱼ + qₖ s sₖ + q sⱼ sₖ",
        {
            **{f"{a}_{a}{b}": f"s_{a} s_{b}" for a in "xyz" for b in "xyz" if a != b},
            "xyz": "product of the two other components, on each axis",
        },
        "sⱼ, sₖ: the two other components; of the last product still poses show one coefficient for all axes",
    ),
    "temperature_bias": Meaning(
        "the bias goes with temperature",
        "The zero of the element or of its electronics changes as they warm.",
        "e = q (T − T₀)", {"*": "T − T₀"}, "T: temp_c", _T,
    ),
    "temperature_bias_quadratic": Meaning(
        "the bias follows temperature along a parabola",
        "The zero changes with temperature, and not in a straight line.",
        "e = p (T − T₀) + q (T − T₀)²", {"linear_*": "T − T₀", "quadratic_*": "(T − T₀)²"}, "T: temp_c", _T,
    ),
    "temperature_scale_factor": Meaning(
        "the scale factor goes with temperature",
        "A spring, a gap or a reference voltage changes as it warms.",
        "e = q (T − T₀) s", {"*": "(T − T₀) s"}, "T: temp_c", _T,
    ),
    "thermal_gradient": Meaning(
        "the bias goes with how fast the temperature changes",
        "While the unit warms or cools, one side of it is warmer than the other.",
        "e = q dT/dt", {"*": "dT/dt"}, "T: temp_c, by the second",
    ),
    "temperature_lag": Meaning(
        "the bias follows the temperature late",
        "What makes it warms and cools later than the thermometer.",
        "e = q (θ − T₀), τ dθ/dt = T − θ", {"*": "θ − T₀", "time_constant": "τ"},
        "T: temp_c; θ: the same after a first-order lag of the time constant τ", _T,
    ),
    "channel_bias": Meaning(
        "the bias goes with {c}",
        "What {c} measures acts on the zero of the unit, or moves together with something that does.",
        "e = q (c − c₀)", {"*": "c − c₀"}, "c: {c}, as logged", _C,
    ),
    "channel_scale_factor": Meaning(
        "the scale factor goes with {c}",
        "What {c} measures acts on the scale of the unit, or moves together with something that does.",
        "e = q (c − c₀) s", {"*": "(c − c₀) s"}, "c: {c}, as logged", _C,
    ),
    "bias_drift": Meaning(
        "the bias drifts with time",
        "The unit had not settled, or something around it changed slowly. It belongs to this recording, not to the "
        "unit.",
        "e = q (t − t₀) + q₂ (t − t₀)² + q₃ (t − t₀)³",
        {"*": "t − t₀", "*2": "(t − t₀)²", "*3": "(t − t₀)³"}, "t: time in s; powers without a coefficient are zero",
        ("t₀", "t_s"),
    ),
    "scale_factor_drift": Meaning(
        "the scale factor drifts with time",
        "The unit had not settled: a reference voltage or a magnet still warmed. It belongs to this recording, not to "
        "the unit.",
        "e = q (t − t₀) s", {"*": "(t − t₀) s"}, "t: time in s", ("t₀", "t_s"),
    ),
    "warm_up": Meaning(
        "the bias settles after the start, as while a unit warms up",
        "The unit was switched on shortly before. It belongs to this recording, not to the unit.",
        "e = q exp(−t / τ)", {"*": "exp(−t / τ)", "time_constant": "τ"}, "t: seconds since the recording began",
    ),
    "bias_step": Meaning(
        "the bias jumps at one moment",
        "A knock, a change of the supply, a part that came loose. It belongs to this recording, not to the unit.",
        "e = −q before t₁, 0 after it", {"*": "−1 before t₁, 0 after", "at": "t₁"},
        "t₁: seconds since the recording began", in_run="{by}, t₁ in recording {n}; all earlier ones are before it",
    ),
    "run_bias": Meaning(
        "the bias comes back a little different at every start",
        "What is switched off and on does not settle in quite the same place. It belongs to these recordings, not to "
        "the unit.",
        "e = q", {"*": "1"}, _OF_RUNS, in_run=_AGAINST_FIRST,
    ),
    "run_scale_factor": Meaning(
        "the scale factor comes back a little different at every start",
        "What is switched off and on does not settle in quite the same place, or something that nobody logged was "
        "different. It belongs to these recordings, not to the unit.",
        "e = q s", {"*": "s"}, _OF_RUNS, in_run=_AGAINST_FIRST,
    ),
    "hysteresis": Meaning(
        "the reading depends on the pose before",
        "The element, its mounting or the fixture does not come all the way back.",
        "e = q s′  or  e = q sign(s − s′)", {"*": "s′", "sign_*": "sign(s − s′)"},
        "s′: the specific force along the axis in the pose before",
    ),
    "remanence": Meaning(
        "the bias keeps the sign of the load in the pose before",
        "Iron that was magnetised, a charge that was left, a joint that slipped.",
        "e = q sign(s′)", {"*": "sign(s′)"}, "s′: the specific force along the axis in the pose before",
    ),
    "vibration_rectification": Meaning(
        "vibration shifts the bias",
        "The element is not straight, so that shaking it does not average to zero.",
        "e = q v", {"*": "v"}, "v: variance of the readings inside the pose, in g²",
    ),
    "empirical": Meaning(
        "a smooth pattern is left that no known effect explains",
        "It describes what is left in these poses and does not say what makes it.",
        "e = s f",
        {
            **{f"odd_{k}": "s × harmonic of degree 3" for k in range(1, 8)},
            **{f"even_{k}": "s × harmonic of degree 4" for k in range(1, 10)},
            **{f"time_{d}": f"s ((t − t₀) / 1000 s){p}" for d, p in ((1, ""), (2, "²"), (3, "³"), (4, "⁴"))},
        },
        "f: a smooth function of the direction or of the time", ("t₀", "t_s"),
    ),
}  # fmt: skip
QUALITY = {
    "saturation": "Readings at the end of the range",
    "stuck_output": "Output frozen",
    "missing_samples": "Samples missing",
    "duplicate_samples": "Samples that came twice",
    "out_of_order_samples": "Samples out of order",
    "bus_errors": "Errors on the bus",
    "mains_pickup": "Mains hum",
    "coarse_quantization": "Steps of the output too coarse",
    "creeping_pose": "Outputs creep while the pose is held",
    "unknown_noise": "Noise of the pose means not known",
}
_NAME = re.compile(
    r"\b(?:(?:channel_bias|channel_scale_factor):[^\s,;]+?(?=[:,;.]?(?:\s|$))|"
    + "|".join(sorted((*_MEANINGS, *QUALITY), key=len, reverse=True))
    + r")(?!\w)"
)
_RUN = re.compile(r"(.+)_run([1-9]\d{0,3})(_alone)?")
_TIMES = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)(?: 1)?e([+-]\d{1,3})(?= \S)")
_EXPONENT = re.compile(r"(?<![\w.])(?<!\d )(\d(?:\.\d{1,8})?)e[+-]\d{1,2}(?![\w.])")


def told(effect: str, references: Mapping[str, float | None]) -> Told:
    """``references`` are the values from which the conditions count, by channel."""
    meaning, channel = _meaning(effect)
    title = effect_title(effect)
    if meaning is None:
        return Told(title, title.lower(), "", "", "")
    letter, name = meaning.reference or ("", "")
    value = references.get(name.replace("{c}", covariate_of(channel)))
    where = [meaning.symbols] if meaning.symbols else []
    if letter == "t₀" and RUN in references:
        where.append("t₀: the middle of each recording's poses")
    elif letter and value is not None:
        where.append(f"{letter} = {value:.6g}".replace("-", "−"))
    clause, because, formula, symbols = (
        text.replace("{c}", channel) for text in (meaning.clause, meaning.because, meaning.formula, "; ".join(where))
    )
    return Told(title, clause, because, formula, symbols)


def factor(effect: str, coefficient: str) -> tuple[str, str]:
    """The axis that a coefficient acts on, and what it is multiplied by; empty where that is not known."""
    meaning, _ = _meaning(effect)
    coefficient, run, alone = run_of(coefficient)
    axis, by = _factor(meaning.factors if meaning else {}, coefficient)
    if meaning is None or run is None or not by:
        return axis, by
    return axis, (_ALONE if alone else meaning.in_run).format(by=by, n=run)


def run_of(coefficient: str) -> tuple[str, int | None, bool]:
    """A coefficient's name without the recording that it names (the first is 1, None where it names none), and whether
    that differs from all others, which are alike."""
    found = _RUN.fullmatch(coefficient)
    return (found[1], int(found[2]), bool(found[3])) if found else (coefficient, None, False)


def _factor(factors: Mapping[str, str], coefficient: str) -> tuple[str, str]:
    if coefficient in factors:
        return (coefficient[0] if re.fullmatch(r"[xyz]_[xyz]{2}", coefficient) else ""), factors[coefficient]
    for axis in "xyz":
        for pattern, by in factors.items():
            if "*" in pattern and coefficient == pattern.replace("*", axis):
                return axis, by
    return "", ""


def in_plain(text: str, *, begins: bool = True) -> str:
    """A sentence of a document with names and powers of ten as people write them; ``begins``: with a capital."""
    said = _EXPONENT.sub(lambda found: _written_out(found[0], found[1]), text)
    said = _TIMES.sub(lambda found: f"{found[1]} × {power(int(found[2]))}", said)
    said = _NAME.sub(lambda found: _plain(found[0]), said)
    return said[:1].upper() + said[1:] if begins else said


def _written_out(number: str, mantissa: str) -> str:
    """`1e-12` as 10⁻¹², with as many digits as it has."""
    text = digits(float(number), len(mantissa.replace(".", "")))
    return text.removeprefix("1 × ")


def _plain(name: str) -> str:
    if name in QUALITY:
        return name.replace("_", " ")
    head, _, channel = effect_title(name).partition(":")
    return head.lower() + (f":{channel}" if channel else "")


def _meaning(effect: str) -> tuple[Meaning | None, str]:
    name, _, channel = effect.partition(":")
    return _MEANINGS.get(name), clean(channel)
