"""What a person sees while a run trains."""

import sys
import time

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress


class Progress:
    """A progress bar on a terminal; elsewhere a line at every evaluation.

    Args:
        total_frames: Where the bar ends.
        frames: Where it starts.
    """

    def __init__(self, total_frames: int, frames: int) -> None:
        self._terminal = sys.stdout.isatty()
        self._bar = RichProgress(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
            TextColumn("{task.fields[speed]}"),
            TextColumn("{task.fields[success]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            disable=not self._terminal,
        )
        self._task = self._bar.add_task("training", total=total_frames, completed=frames, speed="", success="")
        self._total = total_frames
        self._started = time.monotonic()
        self._first = frames

    def start(self) -> None:
        """Show it."""
        self._bar.start()

    def stop(self) -> None:
        """Leave it as it is."""
        self._bar.stop()

    def update(self, frames: int, frames_per_second: float, values: dict[str, float]) -> None:
        """Show how far the run is."""
        success = values.get("evaluation/success_rate")
        self._bar.update(self._task, completed=min(frames, self._total), speed=f"{frames_per_second:,.0f}/s")
        if success is not None:
            self._bar.update(self._task, success=f"success {success:.1%}")
        if not self._terminal and success is not None:
            spent = time.monotonic() - self._started
            left = spent / max(1, frames - self._first) * max(0, self._total - frames)
            print(
                f"{frames:>9,} frames  {frames_per_second:>6,.0f}/s  success {success:6.1%}  "
                f"return {values['evaluation/return']:7.2f}  {left:4.0f} s left",
                flush=True,
            )
