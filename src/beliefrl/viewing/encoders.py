"""Videos as files, frame by frame: mp4 (by imageio-ffmpeg, extra `video`) and GIF (by Pillow)."""

import pathlib
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from PIL import Image

from beliefrl.errors import UserError, cause
from beliefrl.runs.arrays import replacing
from beliefrl.viewing.episodes import Pixels

Writer = Callable[[Pixels], None]


@contextmanager
def encoder(path: pathlib.Path, kind: str, fps: float) -> Iterator[Writer]:
    """A function that adds a frame to the video `path`, of a `kind` .mp4 or .gif. No file is left half written."""
    write, shapes = {".mp4": _mp4, ".gif": _gif}[kind], set()
    try:
        with replacing(path) as temporary, write(temporary, fps) as add:

            def checked(pixels: Pixels) -> None:
                shapes.add(pixels.shape)
                if len(shapes) > 1:
                    raise UserError("The environment renders frames of different sizes: all must have the same size.")
                add(pixels)

            yield checked
    except OSError as error:
        raise UserError(f"{path} cannot be written ({cause(error)}): choose another file.") from None


@contextmanager
def _mp4(path: pathlib.Path, fps: float) -> Iterator[Writer]:
    """Encode as H.264, which any player shows; each frame is piped to ffmpeg."""
    import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

    # imageio-ffmpeg's own writer forks this process. That may hang, since JAX runs threads in it.
    codec = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "18"]
    encoding = [*codec, "-movflags", "+faststart", "-f", "mp4", str(path)]
    ffmpeg: Any = None

    def add(pixels: Pixels) -> None:
        nonlocal ffmpeg
        if ffmpeg is None:
            size = f"{pixels.shape[1]}x{pixels.shape[0]}"
            given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps}", "-i", "-"]
            command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-y", *given, *encoding]
            pipe = subprocess.PIPE  # so Ctrl-C does not reach ffmpeg
            ffmpeg = subprocess.Popen(command, stdin=pipe, stderr=pipe, start_new_session=True)
        ffmpeg.stdin.write(pixels.tobytes())

    broken = False
    try:
        try:
            yield add
        except BrokenPipeError:  # ffmpeg has ended, and says why
            if ffmpeg is None:
                raise
            broken = True
        message = ffmpeg.communicate()[1].decode(errors="replace").strip()
        if ffmpeg.returncode or broken:
            raise OSError(message or f"ffmpeg ended with code {ffmpeg.returncode}")
    finally:
        if ffmpeg is not None and ffmpeg.poll() is None:
            ffmpeg.kill()
            ffmpeg.communicate()


@contextmanager
def _gif(path: pathlib.Path, fps: float) -> Iterator[Writer]:
    """Keep all frames, reduced to 256 colours, and encode them at the end."""
    frames: list[Image.Image] = []
    yield lambda pixels: frames.append(_reduced(Image.fromarray(pixels)))
    delay = max(2, round(100 / fps)) * 10  # milliseconds, a multiple of 10 as GIF requires
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:], duration=delay, loop=0)


def _reduced(image: Image.Image) -> Image.Image:
    """The image with at most 256 colours. An octree is fast, and good enough for drawings of few colours."""
    drawn = image.getcolors(maxcolors=1024) is not None
    method = Image.Quantize.FASTOCTREE if drawn else Image.Quantize.MEDIANCUT
    return image.quantize(method=method, dither=Image.Dither.NONE)
