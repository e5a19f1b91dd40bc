"""What commands that are positions promise, again and simply: near the arm, in its limits, constant while it stands."""

import math

STILL = [0.0, 0.0]
_EDGE = 1e-9  # rad


class Targets:
    """Sees the targets of two joints, one update after another.

    Attributes:
        target: The last one, rad; None before the arm is known.
        way: How far it moved at the last update, rad.
        held: Joints whose target the arm or a limit held back at the last update.
    """

    def __init__(self, lower, upper):
        self.limits = list(zip(lower, upper, strict=True))
        self.turns = [math.isinf(high) for high in upper]
        self.target, self.way, self.held, self.drove = None, STILL, set(), False

    def velocity(self, position, elapsed, fastest):
        """How an arm moves that goes to its target as fast as it may."""
        if self.target is None:
            return STILL
        gaps = [goal - q for goal, q in zip(self._as_counted(position), position, strict=True)]
        return [min(fastest, max(-fastest, gap / elapsed)) for gap in gaps]

    def begins(self, position):
        """Where an update finds the target: where the arm is, if it stood."""
        return self._as_counted(position) if self.drove else position

    def stood(self, target, position, lead):
        """See the target of an arm that stands; return whether it is a new one, since the arm was moved far away."""
        elsewhere = False
        expected = None if self.drove or self.target is None else self._as_counted(position)
        if expected is None or max(abs(one - q) for one, q in zip(expected, position, strict=True)) > lead:
            elsewhere, expected = expected is not None, position
        assert max(abs(one - other) for one, other in zip(target, expected, strict=True)) < _EDGE, (target, expected)
        self.target, self.way, self.held, self.drove = target, STILL, set(), False
        return elsewhere

    def moved(self, target, position, lead):
        """See the target of an arm that is driven."""
        begins = self.begins(position)
        self.target, self.held, self.drove = target, set(), True
        self.way = [new - old for new, old in zip(target, begins, strict=True)]
        for joint, (new, q, (lower, upper)) in enumerate(zip(target, position, self.limits, strict=True)):
            assert abs(new - q) <= lead + _EDGE, (new, q)
            assert min(q, lower) - _EDGE <= new <= max(q, upper) + _EDGE, (new, q)
            if any(abs(new - edge) < _EDGE for edge in (q - lead, q + lead, min(q, lower), max(q, upper))):
                self.held.add(joint)

    def _as_counted(self, position):
        """The target, in the turn in which the robot counts its joints."""
        return [
            goal + math.tau * round((q - goal) / math.tau) if turns else goal
            for goal, q, turns in zip(self.target, position, self.turns, strict=True)
        ]
