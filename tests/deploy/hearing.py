"""The part of the model that is about joint states: which are taken, and what they say of the arm."""

import math

from tests.deploy.motion import CLOSE

NAMES = ("joint1", "joint2")
WHOLE = ((0, 0), (1, 1))


class Hearing:
    """What has been heard of an arm, joint by joint; a part of :class:`tests.deploy.world.World`."""

    def _take_state(self, state, stop, verdict):
        """Return what is to be made of it."""
        before = min(self.heard)
        verdict = verdict or self._judge(state)
        if verdict == "good" and self._see(before):
            verdict = "implausible"
        self.seen[verdict] += 1
        if verdict == "good":
            if not stop and self.complete:
                self.needed = max(0, self.needed - 1)
        elif verdict == "implausible":
            self._hold()
        elif verdict == "malformed" and self.needed:
            self.needed = self.config.recovery_states
        return verdict

    def _judge(self, state):
        names, count = state.names, len(state.names)
        places = WHOLE if names == NAMES else [(j, names.index(name)) for j, name in enumerate(NAMES) if name in names]
        if not places:
            return "other"
        if names != NAMES and len(set(names)) < count:
            return "malformed"
        if len(state.position) != count or len(state.velocity) not in (0, count) or len(state.effort) not in (0, count):
            return "malformed"
        position = [state.position[i] for _, i in places]
        if not (math.isfinite(state.stamp) and all(map(math.isfinite, position))):
            return "malformed"
        received = self.now if state.received is None else min(state.received, self.now)
        velocity = [state.velocity[i] for _, i in places] if len(state.velocity) else [math.nan] * len(places)
        moves, times, plausible, stamp = [], [], True, state.stamp
        for (joint, _), q in zip(places, position, strict=True):
            told, self.told[joint] = self.told[joint], (q, stamp, received)
            if told is None:
                moves.append(0.0)
                times.append(math.inf)
                continue
            before, elapsed, passed = told[0], stamp - told[1], received - told[2]
            moved = q - before
            if self.turns[joint] and not -3 < moved < 3:  # the shorter way around
                moved = math.remainder(moved, math.tau)
                self.seen["around"] += abs(moved) < 3
            allowed = min(elapsed, max(0.0, passed) + self.config.state_timeout)
            plausible &= elapsed > 0 and abs(moved) <= self.plausible[joint] * allowed + 0.01
            moves.append(moved)
            times.append(elapsed)
        if not plausible:
            return "implausible"
        for (joint, _), moved in zip(places, moves, strict=True):
            self.moved[joint] += moved
        if not all(map(math.isfinite, velocity)):
            unknown = [row for row, speed in enumerate(velocity) if not math.isfinite(speed)]
            if (
                not self.config.allow_velocity_estimate
                or max(times[row] for row in unknown) > self.config.state_timeout
            ):
                return "malformed"
            for row in unknown:
                most = self.plausible[places[row][0]]
                velocity[row] = min(most, max(-most, moves[row] / times[row]))
        if any(abs(speed) > self.plausible[joint] for speed, (joint, _) in zip(velocity, places, strict=True)):
            return "implausible"
        if self.now - received > self.config.state_timeout:
            return "implausible"
        self.another = False
        if len(state.effort):
            self.feels = True
        for speed, q, (joint, i) in zip(velocity, position, places, strict=True):
            self.accepted[joint], self.speed[joint], self.heard[joint] = q, speed, received
            if self.feels:
                self.effort[joint] = state.effort[i] if len(state.effort) else math.nan
            if state.source is not None:
                self.another |= self.sources[joint] not in (None, state.source)
                self.sources[joint] = state.source
        self.fresh |= {joint for joint, _ in places}
        self.complete = len(self.fresh) == len(NAMES)
        if self.complete:
            self.fresh = set()
        return "good"

    def _see(self, before):
        """Look at a good state; return whether its velocities contradict its positions."""
        config, received = self.config, min(self.heard)
        if self.another or (before > -math.inf and received - before > config.resume_timeout):
            self._hold()
            if self.goal is not None:
                self.seen["goal forgotten"] += 1
                self.seen["goal forgotten after a silence"] += not self.another
                self._forget()
        self._see_position()
        if received == -math.inf:
            return False
        if self.feels:
            rows = zip(self.effort, self.strongest, self.too_strong, strict=True)
            self.too_strong = [min(since, received) if abs(e) > most else math.inf for e, most, since in rows]
            since = min(self.too_strong)
            if since < math.inf and received - since >= config.effort_time:
                self._fault("effort")
        differs = self.motion.heard(received, self.moved, self.speed)
        if differs is None:
            return False
        missed, contradicted = differs
        counters = self.controller.snapshot()["counters"] if min(map(abs, differs)) < CLOSE else {}
        if abs(missed) < CLOSE:
            missed = counters.get("faults: following", 0) - self.seen["faults: following"]
        if missed > 0:
            self._fault("following")
            return False
        if abs(contradicted) < CLOSE:
            name = "states rejected: velocity inconsistent"
            contradicted = counters.get(name, 0) - self.seen["contradicted"]
        self.seen["contradicted"] += contradicted > 0
        return contradicted > 0

    def _see_position(self):
        far = self.config.limit_fault
        if any(q < lower - far or q > upper + far for q, lower, upper in self._against_limits()):
            self._fault("position")

    def _see_age(self, now, reasons, said):
        oldest = min(self.heard)
        old = oldest > -math.inf and now - oldest > self.config.state_timeout
        if old:
            self._hold()
            one = max(self.heard) == oldest
            what = "joint state" if one else f"state of '{NAMES[self.heard.index(oldest)]}'"
            assert f"the last {what} is {now - oldest:.3f} s old" in reasons
        assert ("the last" in said) == old
