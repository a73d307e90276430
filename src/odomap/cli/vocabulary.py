"""`odomap vocabulary`: the words that places are recognised by: train, look at, convert them."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from odomap.cli.progress import Steps

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from odomap.files.vocabulary import Vocabulary
    from odomap.sources.gathering import Gathering

__all__ = ["ConvertWords", "TrainWords", "VocabularyVerb", "WordsInfo"]

FEW_IMAGES = 100
"""With less, words say little about other places than those seen."""
SHOWN = 5
"""Images that could not be read are named one by one up to so many."""


@dataclass(frozen=True)
class TrainWords:
    """Train a vocabulary on images: hundreds of different places give one of use.

    All kinds together: folders, patterns, pictures, videos, recordings ('sim:room?seed=3', too).
    """

    images: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="IMAGES")]
    """Folders of images, patterns such as 'left/*.png', picture files, recordings, videos."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("words.odomap-vocabulary")
    """Where to write it."""
    branching: Annotated[int, tyro.conf.arg(metavar="K")] = 10
    """Children of a node of the tree."""
    depth: Annotated[int, tyro.conf.arg(metavar="L")] = 5
    """Levels of the tree: at most K to the L words."""
    features: Annotated[int, tyro.conf.arg(metavar="N")] = 1000
    """ORB features per image."""
    most: Annotated[int, tyro.conf.arg(metavar="N")] = 5000
    """Look at so many images, evenly spaced; 1,000 with 1,000 features each take 300 MB."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the random draws: the same images and seed give the same file."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Read, train, write, and say what was made."""
        from odomap.errors import InputError, OutputError
        from odomap.files.atomic import find_obstacle
        from odomap.files.vocabulary import Vocabulary
        from odomap.sources.gathering import Gathering

        for name, value in (("most", self.most), ("features", self.features)):
            if value < 1:
                raise InputError(f"--{name} {value}: must be 1 or more")
        if self.seed < 0:
            raise InputError(f"--seed {self.seed}: must be 0 or more")
        obstacle = find_obstacle(self.out)
        if obstacle is not None or not self.out.parent.is_dir():
            problem = obstacle or "the folder does not exist: create it first"
            raise OutputError(f"{self.out}: cannot be written: {problem}")
        gathering = Gathering(self.images, self.most)
        with Steps("reading", self.quiet) as steps:
            descriptors = described(gathering, self.features, steps)
        with Steps("training", self.quiet) as steps:
            vocabulary = Vocabulary.train(
                descriptors, self.branching, self.depth, self.seed, steps.show
            )
        vocabulary.save(self.out)
        if len(descriptors) < FEW_IMAGES:
            print(
                f"odomap: warning: {len(descriptors)} images: they tell those places apart, but "
                f"hardly others; some {FEW_IMAGES} different ones are needed",
                file=sys.stderr,
            )
        images = f"{len(descriptors)} of {gathering.total}"
        print(f"{'images':<14} {images}, {sum(map(len, descriptors))} features")
        print("\n".join(lines(facts_of(vocabulary, self.out))))
        return 0


@dataclass(frozen=True)
class WordsInfo:
    """Say what a vocabulary holds; without a file, that which comes with odomap."""

    file: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="FILE")] = None
    """A vocabulary."""
    json: bool = False
    """Print JSON."""

    def execute(self) -> int:
        """Print the facts."""
        from odomap.files.vocabulary import Vocabulary, default_vocabulary_path

        file = default_vocabulary_path() if self.file is None else self.file
        facts = facts_of(Vocabulary.load(file), file)
        print(json.dumps(facts, indent=2) if self.json else "\n".join(lines(facts)))
        return 0


@dataclass(frozen=True)
class ConvertWords:
    """Convert a vocabulary of DBoW2's text format, such as ORB-SLAM's, or cut one to less levels.

    The descriptors of odomap are those of OpenCV's ORB, and so are ORB-SLAM's.
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """DBoW2's text (.txt, .txt.gz, .txt.xz), or a vocabulary of odomap."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("words.odomap-vocabulary")
    """Where to write it."""
    depth: Annotated[int | None, tyro.conf.arg(metavar="L")] = None
    """Levels to keep; each less makes it ten times smaller."""
    quiet: bool = False
    """No progress."""

    def execute(self) -> int:
        """Read, cut, write, and say what was made."""
        from odomap.files.vocabulary import SUFFIX, Vocabulary

        with Steps("reading", self.quiet) as steps:
            is_ours = self.file.suffix == SUFFIX
            vocabulary = (
                Vocabulary.load(self.file)
                if is_ours
                else Vocabulary.read_dbow2(self.file, steps.show)
            )
        if self.depth is not None:
            vocabulary = vocabulary.cut(self.depth)
        vocabulary.save(self.out)
        print("\n".join(lines(facts_of(vocabulary, self.out))))
        return 0


@dataclass(frozen=True)
class VocabularyVerb:
    """Train the words that places are recognised by, look at them, or convert DBoW2's."""

    action: (
        Annotated[TrainWords, tyro.conf.subcommand("train")]
        | Annotated[WordsInfo, tyro.conf.subcommand("info")]
        | Annotated[ConvertWords, tyro.conf.subcommand("convert")]
    )
    """What to do."""

    def execute(self) -> int:
        """Do what was chosen."""
        return self.action.execute()


def described(gathering: "Gathering", count: int, steps: Steps) -> list["NDArray[np.uint8]"]:
    """Return the descriptors of each image that has features; say which cannot be read."""
    from odomap.vision.orb import OrbConfig, extract

    config, descriptors = OrbConfig(count=count), []
    unread = 0
    for done, picture in enumerate(gathering, 1):
        steps.show(done, len(gathering), Path(picture.name).name)
        if picture.image is None:
            unread += 1
            if unread <= SHOWN:
                print(f"odomap: warning: {picture.name}: {picture.reason}", file=sys.stderr)
            continue
        features = extract(picture.image, config)
        if len(features):
            descriptors.append(features.descriptors)
    if unread > SHOWN:
        print(f"odomap: warning: {unread} images could not be read in all", file=sys.stderr)
    return descriptors


def facts_of(vocabulary: "Vocabulary", path: Path) -> dict[str, Any]:
    """Return what is to be said about a vocabulary, plain numbers and texts."""
    weights = vocabulary.weights
    return {
        "file": str(path),
        "bytes": path.stat().st_size,
        "words": vocabulary.num_words,
        "nodes": len(vocabulary.num_children),
        "branching": vocabulary.branching,
        "depth": vocabulary.depth,
        "images": vocabulary.num_images,
        "weights": [round(float(weights.min()), 4), round(float(weights.max()), 4)],
        "fingerprint": vocabulary.fingerprint,
    }


def lines(facts: dict[str, Any]) -> list[str]:
    """Return the facts as lines for people."""
    images = f"on {facts['images']} images" if facts["images"] else "not said on how many images"
    rows = [
        ("words", f"{facts['words']}, of 256 bits"),
        ("tree", f"{facts['branching']} branches, {facts['depth']} levels, {facts['nodes']} nodes"),
        ("trained", images),
        ("weights", "{:.4g} to {:.4g}".format(*facts["weights"])),
        ("fingerprint", facts["fingerprint"]),
        ("file", f"{facts['file']}, {facts['bytes'] / 2**20:.2f} MB"),
    ]
    return [f"{name:<14} {text}" for name, text in rows]
