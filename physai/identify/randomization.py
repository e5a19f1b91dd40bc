"""What was found as a randomization: a file to train with, centred on the robot and as wide as it is uncertain."""

from collections.abc import Sequence

import numpy as np

from physai.identify.fit import SPREAD, Fit
from physai.physics import ParameterLayout, RandomizationConfig
from physai.physics.randomization import Draw, LogUniform, Normal, Uniform

FLOOR = 0.05  # units; half of the narrowest range: 5 % of a mass, 15 g, 1 mrad (see docs/identify.md)
_OF_EFFORT, _MOST = ("joint_friction", "armature"), 0.25  # whose units follow the effort: at most so much of the value
_SENSORS = 0.2  # share by which the noise that was measured may be more or less


def identified(found: Fit, layout: ParameterLayout, base: RandomizationConfig) -> RandomizationConfig:
    """Draw robots from what was found.

    What the data tell is drawn from its 95 % interval, or from ``FLOOR`` units about it. Parameters that cannot be told
    apart are held together: each is drawn as if the others were known, for no motion depends on how they share. What
    showed in no motion is drawn as in ``base``. What was not looked for is as the fit took it: as described; but for
    the encoders' zeros, which are those of ``base``.

    Args:
        found: The fit.
        layout: Of the robot.
        base: What is drawn where nothing is known.
    """
    draws: dict[str, Draw | None] = dict.fromkeys(RandomizationConfig.model_fields)
    names = {label: name for name, columns in layout.columns.items() for label in layout.labels[columns]}
    unknowns = found.unknowns
    low, high = _ends(found)
    for name in dict.fromkeys(names[label] for label in unknowns.labels):
        columns = layout.columns[name]
        rows = [place for place, label in enumerate(unknowns.labels) if names[label] == name]
        ends = np.stack([low[rows], high[rows]])
        nominal = layout.nominal[columns].double().numpy()
        unseen = found.unseen[rows]
        if unseen.any():
            ends[:, unseen] = _of_base(getattr(base, name), nominal)[:, unseen]
        scales = unknowns.in_parts[rows].all()
        draws[name] = _uniform(ends / nominal if scales else ends, "scale" if scales else "set")
    if "encoder_offset" not in draws or draws["encoder_offset"] is None:
        draws["encoder_offset"] = base.encoder_offset
    # A delay is rounded to whole steps: one between two of them is now the one, now the other.
    draws["actuator_delay"] = _uniform(np.array([[np.floor(found.delay)], [np.ceil(found.delay)]]), "set")
    for name, noise in zip(("position_noise", "velocity_noise"), found.sensor_noise, strict=True):
        draws[name] = _uniform(noise * np.array([[1.0 - _SENSORS], [1.0 + _SENSORS]]), "set")
    return RandomizationConfig.model_validate({**draws, "name": "identified"})


def text(randomization: RandomizationConfig, layout: ParameterLayout, about: Sequence[str]) -> str:
    """Return a randomization as YAML, with lines ``about`` it at its top, and the names of columns at its lines."""
    lines = [f"# {line}" for line in about]
    lines.append(f"name: {randomization.name}")
    for name in randomization.model_fields:
        draw = getattr(randomization, name)
        if name == "name":
            continue
        if draw is None:
            lines.append(f"{name}: null")
            continue
        values = ", ".join(f"{key}: {value}" for key, value in draw.model_dump().items())
        several = isinstance(draw, Uniform) and draw.columns is not None
        of = ", ".join(layout.labels[layout.columns[name]]) if several else ""
        lines.append(f"{name}: {{{values}}}{f'  # {of}' if of else ''}")
    return "\n".join(lines) + "\n"


def _ends(found: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the ranges, SI units, [F] each."""
    spread = np.where(found.told, SPREAD * found.deviation, SPREAD * found.alone)
    (low, high), (least_low, least_high) = (
        found.unknowns.values(
            np.clip(found.coordinates + np.array([[-1.0], [1.0]]) * by, found.unknowns.low, found.unknowns.high)
        )
        for by in (spread, np.full_like(spread, FLOOR))
    )
    # Data sheets give wrists the efforts of shoulders: a width in parts of these may be more than all that was found.
    narrow = [label.startswith(_OF_EFFORT) for label in found.unknowns.labels]
    least_low = np.where(narrow, np.maximum(least_low, (1.0 - _MOST) * found.values), least_low)
    least_high = np.where(narrow, np.minimum(least_high, (1.0 + _MOST) * found.values), least_high)
    return np.minimum(low, least_low), np.maximum(high, least_high)


def _of_base(draw: Draw | None, nominal: np.ndarray) -> np.ndarray:
    """Ends of what a randomization draws, SI units, [2, columns]; of a normal distribution up to two deviations."""
    if draw is None:
        return np.stack([nominal, nominal])
    ends = np.empty((2, len(nominal)))
    match draw:
        case Normal():
            ends[:] = draw.mean + 2.0 * draw.std * np.array([[-1.0], [1.0]])
        case Uniform() | LogUniform():
            ends[0], ends[1] = draw.low, draw.high
    return ends * nominal if draw.operation == "scale" else ends + nominal if draw.operation == "add" else ends


def _uniform(ends: np.ndarray, operation: str) -> Uniform:
    low, high = ([float(f"{value:.6g}") for value in row] for row in ends)
    one = len(low) == 1
    return Uniform.model_validate(
        {
            "distribution": "uniform",
            "low": low[0] if one else low,
            "high": high[0] if one else high,
            "operation": operation,
        }
    )
