"""`armperturb view`."""

from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command, Positional
from armperturb.validation import require_number


@dataclass(frozen=True, kw_only=True)
class View(Command):
    """Open MuJoCo's interactive viewer, on a recorded trial or on a person whom the mouse can push; needs a display."""

    needs_simulator = True

    recording: Positional[Path | None] = None
    """Recording whose trial is replayed in a loop; without one, a person at rest."""
    trial: int = 0
    """Which trial of the recording, from 0."""
    slow: float = 1.0
    """How many times slower than real time."""
    subject: Path | None = None
    """TOML file of the person at rest, instead of the thesis's mean person of the relax task."""

    def run(self) -> list[str]:
        """Show the window until it is closed."""
        from armperturb.envs.render.replay import SIGNALS, Replay
        from armperturb.envs.render.viewer import require_display, watch_rig, watch_trial
        from armperturb.recording_files import load_recording
        from armperturb.subject import RELAX, Subject

        require_display()  # before a long recording is read
        require_number("view", "slow", self.slow, above=0.0)
        if self.recording is None:
            watch_rig(RELAX if self.subject is None else Subject.load(self.subject))
        elif self.subject is not None:
            raise ValueError(f"view: subject = {str(self.subject)!r}; expected none together with a recording")
        else:
            recording = load_recording(self.recording, optional=SIGNALS)
            watch_trial(Replay.of_trial(recording, self.trial, str(self.recording)), slow=self.slow)
        return []
