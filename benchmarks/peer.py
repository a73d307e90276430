"""The peer, ORB-SLAM3: where it is, and how it is run.

It is a program of its own (GPL, in a virtual environment of its own, see `--group bench` in
pyproject.toml); nothing of it is part of odomap. Three things must be known, by option or variable:

    --data         ODOMAP_DATA          folder of the recordings; its peer/ holds the vocabulary
    --peer-python  ODOMAP_PEER_PYTHON   Python of the environment with pyorbslam3
    --peer-script  ODOMAP_PEER_SCRIPT   script that plays a recording to it
"""

import argparse
import lzma
import os
from pathlib import Path
from typing import NoReturn

from played import Played, play

from odomap.files.rig import read_rig

LAUNCHER = Path(__file__).parent / "peer_launcher.py"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where recordings and peer are."""
    env = os.environ.get
    parser.add_argument("--data", default=env("ODOMAP_DATA"), help="folder of the recordings")
    parser.add_argument("--peer-python", default=env("ODOMAP_PEER_PYTHON"))
    parser.add_argument("--peer-script", default=env("ODOMAP_PEER_SCRIPT"))
    parser.add_argument("--vocabulary", help="default: DATA/peer/orb_vocabulary.txt.xz")


def require(
    parser: argparse.ArgumentParser,
    options: argparse.Namespace,
    names: tuple[str, ...] = ("data", "peer_python", "peer_script"),
) -> None:
    """End with one line where one of the options is missing or leads nowhere."""
    for name in names:
        flag, variable = "--" + name.replace("_", "-"), f"ODOMAP_{name.upper()}"
        value = getattr(options, name)
        if not value:
            refuse(parser, f"{flag} is needed (or set {variable})")
        if not Path(value).exists():
            refuse(parser, f"{flag}: there is no {value} (give {flag} or set {variable})")
    if "peer_python" in names:
        packed = Path(options.data) / "peer" / "orb_vocabulary.txt.xz"
        options.vocabulary = options.vocabulary or str(packed)
        if not Path(options.vocabulary).exists():
            refuse(parser, f"--vocabulary: there is no {options.vocabulary}")


def refuse(parser: argparse.ArgumentParser, why: str) -> NoReturn:
    """End with exit code 2 and one line."""
    parser.exit(2, f"{parser.prog}: {why}\n")


def unpacked(vocabulary: str, scratch: Path) -> Path:
    """Return the vocabulary as text, unpacked once rather than in every run."""
    if not vocabulary.endswith(".xz"):
        return Path(vocabulary)
    plain = scratch / "vocabulary.txt"
    with lzma.open(vocabulary) as packed:
        plain.write_bytes(packed.read())
    return plain


def run(
    options: argparse.Namespace,
    vocabulary: Path,
    played_as: tuple[str, str],
    data: Path,
    prefix: Path,
    frames: int = 0,
    cv_threads: int = 0,
    extra: tuple[str, ...] = (),
) -> Played:
    """Play a recording to the peer, at the pace of its sensor.

    Args:
        options: with those of `add_options`.
        vocabulary: unpacked.
        played_as: its layout ("euroc", "kitti" or "tum") and the mode ("stereo", "mono", "rgbd").
        data: folder of the recording.
        prefix: of the files it writes.
        frames: how many; 0 for all.
        cv_threads: of Python's OpenCV; 0 for the script's choice.
        extra: further options of the script.
    """
    command = [options.peer_python, str(LAUNCHER), f"{prefix}.json", str(cv_threads)]
    layout, mode = played_as
    command += [options.peer_script, layout, str(data), "--mode", mode, "--pace"]
    command += _calibration(data) if layout == "tum" else []
    command += ["--vocab", str(vocabulary), "--out", str(prefix)]
    command += ["--frames", str(frames)] if frames else []
    command += extra
    return play(command, prefix, f"ORB-SLAM3 on {data.name}")


def _calibration(data: Path) -> list[str]:
    """Return the options that tell the script what a recording of TUM does not say itself."""
    rig = read_rig(data)
    assert rig.depth is not None, f"{data}: the rig has no depth"
    camera = rig.camera(rig.depth.camera).camera
    lens = ",".join(map(repr, camera.distortion.tolist()))
    options = ["--K", ",".join(map(repr, camera.intrinsics.tolist()))]
    options += ["--dist", lens] if lens else []
    return [*options, "--depth-factor", repr(rig.depth.factor)]
