"""What was found, in words and numbers."""

from collections import Counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from physai.identify.fit import SHARE, Fit
from physai.robots import RobotSpec

_FULL_EFFORT = "faster steps, in which the motor gives all that it can"
_SHOWS_IN = {  # what to record for a parameter that shows in no motion
    "link_mass": _FULL_EFFORT,
    "payload": _FULL_EFFORT,
    "joint_damping": _FULL_EFFORT,
    "joint_friction": _FULL_EFFORT,
    "effort_limit": _FULL_EFFORT,
    "armature": _FULL_EFFORT,
    "velocity_gain": "steps that are small enough for the motor to follow",
    "encoder_offset": "fast motions in poses in which gravity pulls at the joint",
}


def show(console: Console, found: Fit, spec: RobotSpec, data: str) -> None:
    """Print what is known, what is not, and how well the found robot predicts motions that it has not seen."""
    table = Table(title=escape(f"{data}: what '{spec.name}' is like"), title_justify="left")
    table.add_column("parameter")
    for column in ("described", "found", "95 % interval"):
        table.add_column(column, justify="right")
    nominal = found.unknowns.values(np.zeros((1, len(found.unknowns))))[0]
    for number, label in enumerate(found.unknowns.labels):
        low, high = found.interval[:, number]
        cannot = "does not show" if found.unseen[number] else "cannot be told alone"
        known = f"{found.values[number]:.4g}", f"{low:.4g} to {high:.4g}"
        table.add_row(escape(label), f"{nominal[number]:.4g}", *(known if found.told[number] else ("", cannot)))
    table.add_row("actuator_delay", "0", f"{found.delay:g}", "control steps")
    console.print(table)
    for line in _advice(found):
        console.print(line, highlight=False, markup=False)
    errors = Table(title="Motions held out: root mean square errors of predicted positions, mrad", title_justify="left")
    for column in ("joint", "as described", "as found"):
        errors.add_column(column, justify="left" if column == "joint" else "right")
    for joint, before, after in zip(spec.joints, 1e3 * found.before, 1e3 * found.after, strict=True):
        errors.add_row(escape(joint), f"{before:.2f}", f"{after:.2f}")
    console.print(errors)
    says = "the noise of the sensors explains them" if found.explained else (
        "the model does not explain them: the robot has something that this engine or these parameters do not"
    )  # fmt: skip
    noise = 1e3 * found.sensor_noise[0]
    console.print(f"Errors are {found.ratio:.2f} times the noise ({noise:.2f} mrad): {says}.", highlight=False)


def summary(found: Fit, spec: RobotSpec) -> dict[str, Any]:
    """Return the same for a JSON file."""
    parameters = {
        label: {
            "value": float(found.values[number]),
            "interval": found.interval[:, number].tolist(),
            "told": bool(found.told[number]),
            "shows": not found.unseen[number],
        }
        for number, label in enumerate(found.unknowns.labels)
    }
    return {
        "parameters": parameters,
        "actuator_delay": found.delay,
        "cannot_be_told_apart": [_words(direction, found) for direction in found.together],
        "held_out": {
            joint: {"described": float(before), "found": float(after)}
            for joint, before, after in zip(spec.joints, found.before, found.after, strict=True)
        },
        "noise": float(found.sensor_noise[0]),
        "ratio": found.ratio,
        "explained": found.explained,
    }


def _advice(found: Fit) -> list[str]:
    """What cannot be told, and what to record to tell it."""
    together = Counter(_words(direction, found) for direction in found.together)
    lines = [
        f"Nothing in these motions tells {words} apart{f': {ways} of them must be known' if ways > 1 else ''}."
        for words, ways in together.items()
    ]
    unseen: dict[str, list[str]] = {}
    for label in np.array(found.unknowns.labels)[found.unseen]:
        unseen.setdefault(_SHOWS_IN[label.partition("[")[0]], []).append(label)
    return lines + [f"To tell {', '.join(labels)}, record {motions}." for motions, labels in unseen.items()]


def _words(direction: np.ndarray, found: Fit) -> str:
    share = np.abs(direction) / np.abs(direction).max()
    return " and ".join(label for label, each in zip(found.unknowns.labels, share, strict=True) if each > SHARE)
