"""`armperturb video`."""

from dataclasses import dataclass, field
from pathlib import Path

from armperturb.commands.command import Command, Positional
from armperturb.envs.render.clip import Clip
from armperturb.files import require_new
from armperturb.progress import Progress


@dataclass(frozen=True, kw_only=True)
class Video(Command):
    """Replay a recorded trial as a video: the rig from above and from the side, forces as arrows, and a strip chart."""

    needs_simulator = True

    recording: Positional[Path]
    """Recording to read (netCDF4), also of a real person, if it holds the lengths of the arm."""
    out: Path
    """Video to write: MP4 (H.264), or GIF."""
    trial: int
    """Which trial of the recording, from 0."""
    clip: Clip = field(default_factory=Clip)
    overwrite: bool = False
    """Replace an existing video; an input is never replaced."""

    def run(self) -> list[str]:
        """Draw the frames and write the video."""
        from armperturb.envs.render.replay import SIGNALS, Replay
        from armperturb.envs.render.video import require_ending, write_video
        from armperturb.recording_files import load_recording

        require_ending(self.out)
        recording = load_recording(self.recording, optional=SIGNALS)
        require_new([self.out], overwrite=self.overwrite)
        replay = Replay.of_trial(recording, self.trial, str(self.recording))
        with Progress("video", total=0, unit="frames") as bar:

            def report_progress(done: int, total: int) -> None:
                bar.total = total
                bar.update(done - bar.n)

            write_video(replay, self.out, self.clip, progress=report_progress)
        return [f"video: {self.out}"]
