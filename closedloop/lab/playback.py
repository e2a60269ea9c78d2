"""The clock of a replay: an instant of the run that moves with the wall clock at a chosen speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

SLOWEST, FASTEST = 0.01, 4.0


@dataclass
class Playback:
    """An instant of a run.

    Attributes
    ----------
    end : float
        The last instant of the run, s.
    time : float
        The instant shown, s.
    speed : float
        Seconds of the run in a second, from `SLOWEST` to `FASTEST`.
    playing, loop : bool
        Whether it moves, and whether it begins anew at the end.
    """

    end: float = 0.0
    time: float = 0.0
    speed: float = 1.0
    playing: bool = False
    loop: bool = True

    def set_end(self, end: float) -> None:
        """Take over another run's end; the instant stays where it is, if that run has it."""
        self.end = max(end, 0.0)
        self.time = min(self.time, self.end)

    def play(self) -> None:
        """Start to move; from the beginning if it is at the end."""
        if self.time >= self.end:
            self.time = 0.0
        self.playing = True

    def pause(self) -> None:
        """Stand still."""
        self.playing = False

    def seek(self, time: float) -> None:
        """Go to an instant, s."""
        self.time = min(max(time, 0.0), self.end)

    def step(self, by: float) -> None:
        """Stand still, so many seconds later or, below 0, earlier."""
        self.pause()
        self.seek(self.time + by)

    def set_speed(self, speed: float) -> None:
        """Set the speed, within its bounds."""
        self.speed = min(max(speed, SLOWEST), FASTEST)

    def advance(self, seconds: float) -> bool:
        """Let so many seconds of the wall clock pass; return whether the instant changed."""
        if not self.playing or self.end <= 0.0:
            return False
        time = self.time + seconds * self.speed
        if time >= self.end:
            time = time % self.end if self.loop else self.end
            self.playing = self.loop
        changed, self.time = time != self.time, time
        return changed

    def next_event(self, instants: Sequence[float], margin: float = 1e-9) -> bool:
        """Stand still at the first of these instants, s, after this one, the first of all after the last.

        Returns
        -------
        bool
            Whether there is any.
        """
        if not len(instants):
            return False
        self.pause()
        self.seek(min((t for t in instants if t > self.time + margin), default=min(instants)))
        return True
