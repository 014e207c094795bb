"""The file in which a search is saved after each step, so that one that was stopped goes on."""

import hashlib
import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from armperturb.analysis.nonlinear.problem import NoiseDraws, Problem, State
from armperturb.analysis.nonlinear.search import Position, Stage
from armperturb.files import written_whole


def digest_of(problem: Problem, *origin: object) -> str:
    """Digest of all that a search depends on: structure, trials, and where and how it begins."""
    digest = hashlib.sha256(repr((problem.parameters.model, *origin)).encode())
    for trials in problem.sets:
        digest.update(repr((trials.label, trials.body, trials.environment, trials.end)).encode())
        for signal in (trials.drive, trials.displacement):
            digest.update(np.ascontiguousarray(signal).tobytes())
    return digest.hexdigest()


def save_position(path: Path, digest: str, position: Position) -> None:
    """Write a position; the file changes all at once.

    Raises:
      OSError: it cannot be written.
    """
    arrays: dict[str, Any] = {
        "digest": digest,
        "stage": position.stage.value,
        "damping": position.damping,
        "n_steps": position.n_steps,
        **{f"state_{name}": values for name, values in position.state._asdict().items()},
        **{f"reference_{name}": values for name, values in position.reference._asdict().items()},
    }
    if position.draws is not None:
        draws = position.draws
        arrays |= {"n_pairs": draws.n_pairs, "seed": draws.seed}
        arrays |= {f"root_{i}": root for i, root in enumerate(draws.roots)}
        arrays |= {f"strength_{i}": strength for i, strength in enumerate(draws.strengths)}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    with written_whole(path) as part:
        part.write_bytes(buffer.getvalue())


def load_position(path: Path, digest: str) -> Position | None:
    """The position that a search with the same digest saved; None without such a file, or if it is damaged.

    Raises:
      OSError: the file is there and cannot be read.
    """
    if not path.exists():
        return None
    content = io.BytesIO(path.read_bytes())
    try:
        with np.load(content) as saved:
            arrays = {name: saved[name] for name in saved.files}
        return _position(arrays) if str(arrays["digest"]) == digest else None
    except (ValueError, OSError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error):
        return None


def _position(arrays: dict[str, Any]) -> Position:
    state, reference = (State(*(arrays[part + name] for name in State._fields)) for part in ("state_", "reference_"))
    draws = None
    if "n_pairs" in arrays:
        n_sets = sum(name.startswith("root_") for name in arrays)
        roots, strengths = (tuple(arrays[f"{part}_{i}"] for i in range(n_sets)) for part in ("root", "strength"))
        draws = NoiseDraws(roots, strengths, int(arrays["n_pairs"]), int(arrays["seed"]))
    return Position(
        stage=Stage(str(arrays["stage"])),
        state=state,
        reference=reference,
        damping=float(arrays["damping"]),
        n_steps=int(arrays["n_steps"]),
        draws=draws,
    )
