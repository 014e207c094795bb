"""Videos of recorded trials: the rig from two sides, forces as arrows, the handle's path, and a strip chart."""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from armperturb.arrays import Array
from armperturb.envs.render.camera import TRAIL, Camera, force_arrows, simplify
from armperturb.envs.render.clip import VIEWS, Clip
from armperturb.envs.render.overlay import StripChart, draw_clock, label_layer, text_size
from armperturb.envs.render.replay import Replay
from armperturb.extras import naming_the_extra
from armperturb.files import written_whole
from armperturb.plots.style import round_number_below

Picture = NDArray[np.uint8]


FRAME_RATES = {".mp4": 30.0, ".gif": 20.0}
"""File ending to frames per second; those of a GIF stay whole hundredths of a second."""


LEAST_FORCE = 1e-6
"""Force [N] below which there is none but rounding: arrows have no scale of their own then."""

LONGEST_ARROW = 0.3
"""Length of the arrow of the largest force [m], unless it would leave the picture."""

LONGEST_SCALE = 0.18
"""Length of the scale's axes at most [m], unless they would be shorter than `SHORTEST_AXIS`."""

SHORTEST_AXIS = 1.5
"""Length of the scale's axes in the picture, over the size of its text."""


def frame_times(replay: Replay, clip: Clip, frame_rate: float) -> Array:
    """Times in the trial that the frames show [s], (frame,).

    Args:
      replay: the trial.
      clip: what is shown of it.
      frame_rate: of the video [Hz].

    Raises:
      ValueError: the clip is outside the trial.
    """
    start, stop = clip.window(replay)
    return np.asarray(
        start + np.arange(max(1, round((stop - start) * clip.slow * frame_rate))) / frame_rate / clip.slow
    )


def frames(replay: Replay, clip: Clip, times: Array) -> Iterator[Picture]:
    """Frames of a video, one after the other, (height, width, 3).

    Args:
      replay: the trial.
      clip: what is shown of it.
      times: in the trial [s], (frame,), as from `frame_times`.

    Raises:
      ValueError: the clip is outside the trial.
      RuntimeError: this machine cannot draw; the message names what to install.
    """
    views, (width, height) = VIEWS[clip.view], clip.size
    shown = replay.between(*clip.window(replay))
    qpos, d, f, displacement = (
        replay.at(values, times) for values in (replay.qpos, replay.disturbance, replay.reaction, replay.displacement)
    )
    simplify(replay.model, height)
    chart = StripChart(shown, width=width * len(views), height=height // 2, unit=text_size(width, height))
    with Camera(replay.model, width=width, height=height) as camera:
        scale = arrow_scale(camera, views, shown)
        layers = [
            label_layer(clip.size, replay.title if i == 0 else "", *scale_axes(camera, view, scale))
            for i, view in enumerate(views)
        ]
        for i, now in enumerate(times):
            past = replay.displacement[(replay.time > now - TRAIL) & (replay.time < now)]
            pictures = []
            for view, layer in zip(views, layers, strict=True):
                arrows, trail = force_arrows(d[i], f[i], scale), np.vstack([past, displacement[i]])
                picture = Image.fromarray(camera.draw(qpos[i], view, arrows=arrows, trail=trail))
                picture.paste(layer, mask=layer)
                if view == views[0]:
                    draw_clock(picture, float(now), clip.slow)
                pictures.append(np.asarray(picture))
            yield np.vstack([np.hstack(pictures), chart.at(float(now))])


def scale_axes(camera: Camera, view: str, scale: float) -> tuple[float, Array]:
    """A round force [N], and its arrows along x and y in a picture, long enough to read [pixel], (axis, 2).

    Args:
      camera: that draws the picture.
      view: "oblique" or "top".
      scale: length per force of the arrows [m/N].
    """
    force = round_number_below(LONGEST_SCALE / scale)
    while True:
        along = camera.handle() + scale * force * np.eye(3)[:2]
        axes = camera.project(along, view) - camera.project(camera.handle(), view)
        if np.linalg.norm(axes, axis=1).min() >= SHORTEST_AXIS * text_size(camera.width, camera.height):
            return force, axes
        force = round_number_below(2.5 * force)  # the next one


def arrow_scale(camera: Camera, views: tuple[str, ...], shown: Replay) -> float:
    """Length per force of arrows that stay within the pictures [m/N].

    Args:
      camera: that draws them.
      views: that are drawn.
      shown: what they are drawn of.
    """
    forces = np.concatenate([shown.disturbance, shown.reaction])
    largest = float(np.linalg.norm(forces, axis=1).max())
    if largest < LEAST_FORCE:
        return LONGEST_ARROW
    starts = camera.handle(np.concatenate([shown.displacement, shown.displacement]))
    flat = np.pad(forces, ((0, 0), (0, 1)))
    margin = 0.03 * camera.height
    limits = np.array([camera.width, camera.height]) - margin
    scale = LONGEST_ARROW / largest
    while scale > 0.1 * LONGEST_ARROW / largest:
        tips = [camera.project(starts + scale * flat, view) for view in views]
        if all(((tip > margin) & (tip < limits)).all() for tip in tips):
            break
        scale *= 0.95
    return scale


def write_video(
    replay: Replay,
    out: str | Path,
    clip: Clip | None = None,
    *,
    progress: Callable[[int, int], object] | None = None,
) -> None:
    """Write a video of a trial, whole or not at all.

    Args:
      replay: the trial.
      out: file to write, MP4 (H.264) or GIF by its ending.
      clip: what is shown, and how; by default the whole trial, from both sides.
      progress: called with the number of frames that are done, and of all.

    Raises:
      ModuleNotFoundError: the encoder is not installed; the message names the extra.
      ValueError: the file has another ending, or the clip is outside the trial.
      RuntimeError: this machine cannot draw; the message names what to install.
      OSError: the file cannot be written, or the encoder failed.
    """
    with naming_the_extra("write_video"):  # here, as mediapy takes long to import
        import imageio_ffmpeg
        import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    out = Path(out)
    ending, clip = require_ending(out), clip or Clip()
    frame_rate = FRAME_RATES[ending]
    times = frame_times(replay, clip, frame_rate)
    width, height = clip.size
    shape = (height + height // 2, width * len(VIEWS[clip.view]))
    with written_whole(out) as temporary, tempfile.TemporaryDirectory() as folder:
        # Elsewhere, as the encoder goes by a file's ending.
        encoded = Path(folder) / f"video{ending}"
        pictures = frames(replay, clip, times)
        first = next(pictures)  # before the encoder starts: where nothing can be drawn, nothing is encoded
        try:
            with _encoder(encoded, shape, frame_rate) as encoder:
                encoder.add_image(first)
                for done, picture in enumerate(pictures, start=1):
                    if progress is not None:
                        progress(done, len(times))
                    encoder.add_image(picture)
        except (BrokenPipeError, RuntimeError) as error:
            if isinstance(error.__context__, KeyboardInterrupt):  # Ctrl-C reaches the encoder, too
                raise error.__context__ from None
            raise OSError(f"{out}: the encoder failed ({' '.join(str(error).split())})") from error
        if progress is not None:
            progress(len(times), len(times))
        copyfile(encoded, temporary)


def require_ending(out: Path) -> str:
    """The ending of a video's file, in small letters.

    Raises:
      ValueError: it is none of `FRAME_RATES`.
    """
    ending = out.suffix.lower()
    if ending not in FRAME_RATES:
        raise ValueError(f"{out}: ending {out.suffix!r}; expected {' or '.join(FRAME_RATES)}")
    return ending


def _encoder(path: Path, shape: tuple[int, int], frame_rate: float) -> Any:
    import mediapy

    if path.suffix == ".gif":
        return mediapy.VideoWriter(path, shape, fps=frame_rate, codec="gif")
    # The index first, so that a browser starts to play before it has the whole file.
    return mediapy.VideoWriter(
        path, shape, fps=frame_rate, codec="h264", crf=20, ffmpeg_args="-preset veryfast -movflags +faststart"
    )
