"""A run as a film: bodies, surface, paths and forces, see `closedloop.lab.film_picture`.

It is drawn by matplotlib without a screen. A .gif needs nothing else; a .mp4 needs the program ffmpeg, that of the
computer or that which the package imageio-ffmpeg carries.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from closedloop.base.errors import OutputError, ScenarioError
from closedloop.base.files import write_whole
from closedloop.base.optional import missing_line
from closedloop.figures.scene.scene import Scene, scene_of
from closedloop.lab.curves import Panel, main_panel, reduced
from closedloop.record.run import Run

if TYPE_CHECKING:
    from closedloop.lab.film_picture import Picture

FRAMES_PER_SECOND = 25
FORMATS = (".gif", ".mp4")
MOST_FRAMES = 5000
# Parts of the time of which a curve shows the extremes, and colours of a .gif.
CELLS, COLOURS = 400, 255
UNCHANGED = 255  # the number, in the palette of a .gif, of a pixel that is as in the frame before
# matplotlib's settings: the user's would change what the film looks like.
OWN: Any = {"font.size": 9, "axes.grid": True, "grid.alpha": 0.3}
NEEDS_FFMPEG = missing_line("a .mp4 needs", "ffmpeg", "mp4") + ", or write a .gif"


def animate(run: Run, path: str | Path, *, speed: float = 1.0, frames_per_second: int = FRAMES_PER_SECOND) -> Path:
    """Write a film of a run and return its path.

    Parameters
    ----------
    path : path
        A .gif or a .mp4.
    speed : float
        Seconds of the run in a second of the film.

    Raises
    ------
    ScenarioError
        If the path has another ending, the run has no rows, or a number is none that a film can have.
    OutputError
        If the file cannot be written, or a .mp4 is asked for and there is no ffmpeg.
    """
    if len(run):
        panel = reduced(main_panel(run), float(run.time[0]), float(run.time[-1]), CELLS)
        return write_film(scene_of(run), panel, Path(path), speed=speed, frames_per_second=frames_per_second)
    raise ScenarioError(f"{run.scenario.name}: the run has 0 rows: there is nothing to show")


def ffmpeg_program() -> str | None:
    """Return the program ffmpeg: that of the computer, else that of the package imageio-ffmpeg; None without either."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # the package without its program
        return None


def _rows(run: Run, speed: float, frames_per_second: int) -> NDArray[np.int64]:
    """Return the row of each frame."""
    count = max(2, round(float(run.time[-1]) / speed * frames_per_second) + 1)
    instants = np.minimum(np.arange(min(count, MOST_FRAMES + 1)) * speed / frames_per_second, run.time[-1])
    return np.minimum(np.round(instants / run.scenario.time.step), len(run) - 1).astype(np.int64)


def write_film(
    scene: Scene, panel: Panel, path: Path, *, speed: float = 1.0, frames_per_second: int = FRAMES_PER_SECOND
) -> Path:
    """Write a film of a scene beside the curves of a panel; see `animate`, which checks what it is given."""
    if path.suffix.lower() not in FORMATS:
        raise ScenarioError(f"{path}: the name of a film must end in {' or '.join(FORMATS)}")
    run = scene.run
    if len(run) < 2:
        raise ScenarioError(f"{run.scenario.name}: the run has {len(run)} rows: there is nothing to show")
    if not (0.0 < speed < 1e6 and 1 <= frames_per_second <= 100):
        raise ScenarioError(
            f"speed = {speed:g}, frames_per_second = {frames_per_second}: must be above 0, and from 1 to 100"
        )
    rows = _rows(run, speed, frames_per_second)
    if rows.size > MOST_FRAMES:
        raise ScenarioError(f"speed = {speed:g}: the film would have {rows.size} frames, over {MOST_FRAMES}")
    ffmpeg = None
    if path.suffix.lower() == ".mp4":
        ffmpeg = ffmpeg_program()
        if ffmpeg is None:
            raise OutputError(f"{path}: {NEEDS_FFMPEG}")
    import matplotlib as mpl

    from closedloop.lab.film_picture import Picture

    with mpl.rc_context(OWN):
        picture = Picture(scene, panel)
        film = _mp4(picture, rows, frames_per_second, ffmpeg) if ffmpeg else _gif(picture, rows, frames_per_second)
    return write_whole(path, film)


def _gif(picture: Picture, rows: NDArray[np.int64], frames_per_second: int) -> bytes:
    """Return a GIF: all frames share one palette, and no colour is mixed from dots of others.

    A pixel that stays as it was is transparent: long runs of one value are written in few bytes.
    """
    from PIL import Image

    def image(row: int) -> Any:
        pixels = picture.pixels(row)
        return Image.frombuffer("RGBA", pixels.shape[1::-1], pixels, "raw", "RGBA", 0, 1).convert("RGB")

    some = np.vstack([np.asarray(image(int(row))) for row in (rows[0], rows[len(rows) // 2], rows[-1])])
    palette = Image.fromarray(some).quantize(COLOURS)
    listed = (palette.getpalette() or [])[: 3 * COLOURS]
    listed += listed[:3] * (256 - len(listed) // 3)  # the rest are the first colour again
    palette.putpalette(listed)

    def changes() -> Iterator[Any]:
        before: NDArray[np.uint8] | None = None
        for row in rows:
            frame = image(int(row)).quantize(palette=palette, dither=Image.Dither.NONE)
            now = np.asarray(frame)
            now = np.where(now == UNCHANGED, np.uint8(0), now)
            frame = Image.fromarray(now if before is None else np.where(now == before, np.uint8(UNCHANGED), now))
            frame.putpalette(listed)
            before = now
            yield frame

    frames, film = changes(), io.BytesIO()
    more = {"duration": 1000.0 / frames_per_second, "loop": 0, "transparency": UNCHANGED, "disposal": 1}
    next(frames).save(film, "GIF", save_all=True, append_images=frames, optimize=False, **more)
    return film.getvalue()


def _mp4(picture: Picture, rows: NDArray[np.int64], frames_per_second: int, ffmpeg: str) -> bytes:
    """Return a .mp4 by the program ffmpeg, which reads the frames as they are drawn."""
    height, width, _ = picture.pixels(int(rows[0])).shape
    with tempfile.TemporaryDirectory(prefix="closedloop-") as folder:
        file = Path(folder) / "film.mp4"
        command = [
            ffmpeg, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgba", "-s", f"{width}x{height}",
            "-r", str(frames_per_second), "-i", "-", "-c:v", "libx264", "-pix_fmt", "yuv420p", str(file),
        ]  # fmt: skip
        with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as program:
            assert program.stdin is not None
            assert program.stderr is not None
            try:
                for row in rows:
                    program.stdin.write(picture.pixels(int(row)).tobytes())
                program.stdin.close()
            except BrokenPipeError:
                pass
            said = program.stderr.read().decode(errors="replace").strip()
        if program.returncode:
            raise OutputError(
                f"ffmpeg could not write the film: {said.splitlines()[-1] if said else 'it says nothing'}"
            )
        return file.read_bytes()
