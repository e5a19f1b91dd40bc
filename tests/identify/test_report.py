"""What was found, in words: also what these motions cannot tell."""

import dataclasses

import numpy as np
from rich.console import Console

from physai.identify.report import show


def shown(found, planar) -> list[str]:
    console = Console(width=200, record=True)
    show(console, found, planar, "robot.csv")
    return console.export_text().splitlines()


def test_what_cannot_be_told_is_no_number(found, planar):
    (mass,) = [line for line in shown(found, planar) if line.startswith("│ link_mass[tool]")]
    (friction,) = [line for line in shown(found, planar) if line.startswith("│ joint_friction[joint2]")]
    assert "cannot be told alone" in mass
    assert "does not show" in friction


def test_parameters_that_only_show_together_are_named_once_and_how_many_of_them_must_be_known(found, planar):
    directions = np.zeros((2, len(found.unknowns)))
    directions[:, 1:4] = [[0.6, 0.6, 0.5], [0.6, -0.6, 0.5]]
    one, both = (
        [line for line in shown(dataclasses.replace(found, together=each), planar) if line.startswith("Nothing")]
        for each in (directions[:1], directions)
    )
    which = "Nothing in these motions tells link_mass[link2] and link_mass[tool] and payload apart"
    assert one == [f"{which}."]
    assert both == [f"{which}: 2 of them must be known."]
