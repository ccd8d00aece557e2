"""Images of many simulated streets with their label images: what `gnss-sem-map train` learns from.

    python examples/training_images.py streets 1 100

writes streets/images and streets/labels (Cityscapes train ids), some images from along each of the streets 1 to 100:
many streets teach more than many images of one. The pixels are those that `gnss-sem-map simulate` writes.
"""

import argparse
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2

from gnss_sem_map.simulation import Simulation, prepare


def main() -> None:
    """Render every n-th image of 30 s in each street."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("first", type=int, help="first seed")
    parser.add_argument("last", type=int, help="last seed")
    parser.add_argument(
        "--every", type=int, default=15, help="frames from one image to the next (default: 15)"
    )
    chosen = parser.parse_args()
    if chosen.last < chosen.first or chosen.every < 1:
        parser.error("expected a last seed from the first on, and --every of 1 or more")
    for kind in ("images", "labels"):
        (chosen.folder / kind).mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor() as pool:
        for seed in range(chosen.first, chosen.last + 1):
            street = prepare(30.0, seed)
            frames = range(0, len(street.sweeps), chosen.every)
            list(pool.map(lambda frame, street=street: write(street, frame, chosen.folder), frames))
            print(f"street {seed} of {chosen.last}", flush=True)


def write(street: Simulation, frame: int, folder: Path) -> None:
    """One image with its labels, under a name that tells the street."""
    image, name = street.image(frame), f"{street.seed:04d}_{frame:010d}.png"
    cv2.imwrite(str(folder / "images" / name), cv2.cvtColor(image.rgb, cv2.COLOR_RGB2BGR))
    cv2.imwrite(str(folder / "labels" / name), image.train_ids)


if __name__ == "__main__":
    main()
