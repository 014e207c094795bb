"""`armperturb live`."""

from dataclasses import dataclass
from pathlib import Path

from armperturb.commands.command import Command
from armperturb.files import require_new


@dataclass(frozen=True, kw_only=True)
class Live(Command):
    """Write the live laboratory: one offline page on which an arm's properties can be turned and its answer seen."""

    out: Path
    """Page to write, e.g. live.html."""
    arms: tuple[Path, ...] = ()
    """TOML files of arms to begin with, e.g. arm.toml that identify writes; the average person and ten people are
    always there."""
    overwrite: bool = False
    """Replace an existing page; an input is never replaced."""

    def run(self) -> list[str]:
        """Write the page."""
        from armperturb.live.page import write_live
        from armperturb.subject import Subject

        arms = {str(path.with_suffix("")): Subject.load(path) for path in self.arms}
        require_new([self.out], overwrite=self.overwrite)
        write_live(self.out, arms)
        return [f"live laboratory: {self.out}"]
