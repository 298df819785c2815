"""COLMAP in a process of its own: ``python -m gshell_mi.capture.colmap_worker FOLDER``.

Its own, since a library of that size brings decoders and threads that get on with nobody else's, cannot be
interrupted from Python, and ends the process where it fails. All that it makes is in the folder, so that a
second run goes on where the first was stopped:

- ``job.json`` and ``images/``: what it is asked for, see ``structure_from_motion``;
- ``features.db``: features and raw matches, filled image by image and pair by pair;
- ``verified.db``: matches that remain after the room was taken out, geometrically verified;
- ``models/0`` ...: the models found, and ``mapping.progress``: a byte per photograph placed.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap

from ..lifetime import end_with_parent
from .pairs import pairs_of
from .stationary import stationary_features

#: A room is taken out of the matches if more than this share of the features stands still.
_ROOM = 0.02
_SEED = 1


def run(folder: Path) -> None:
    """Does what ``job.json`` asks for."""
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    pycolmap.set_random_seed(_SEED)
    if not (folder / "verified.db").is_file():
        _match(folder, job)
        _verify(folder, job)
    _map(folder)


def _match(folder: Path, job: dict) -> None:
    database, names = folder / "features.db", job["images"]
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = job["features"]
    for camera in job["cameras"]:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"
        if camera["parameters"]:
            reader.camera_params = ", ".join(map(str, camera["parameters"]))
        pycolmap.extract_features(
            database,
            folder / "images",
            image_names=camera["images"],
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
    pairs = folder / "pairs.txt"
    pairs.write_text(
        "".join(f"{first} {second}\n" for first, second in pairs_of(names, sequential=job["sequential"])),
        encoding="utf-8",
    )
    matching = pycolmap.FeatureMatchingOptions()
    matching.skip_geometric_verification = True  # only once it is known what belongs to the room
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs
    pycolmap.match_image_pairs(
        database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
    )


def _verify(folder: Path, job: dict) -> None:
    partial = folder / "partial.db"
    partial.unlink(missing_ok=True)
    with closing(sqlite3.connect(folder / "features.db")) as old, closing(sqlite3.connect(partial)) as new:
        old.backup(new)  # a copied file would lack what is still in the journal
    with pycolmap.Database.open(partial) as database:
        images = [image.image_id for image in database.read_all_images()]
        points = {image: np.array(database.read_keypoints(image))[:, :2] for image in images}
        numbers, found = database.read_all_matches()
        matches = {
            pycolmap.pair_id_to_image_pair(number): np.array(pair)
            for number, pair in zip(numbers, found, strict=True)
            if len(pair)
        }
        still = stationary_features(points, matches, job["size"])
        share = np.concatenate(list(still.values())).mean() if still else 0.0
        if share > _ROOM:
            for (first, second), pair in matches.items():
                moving = ~(still[first][pair[:, 0]] | still[second][pair[:, 1]])
                database.delete_matches(first, second)
                database.write_matches(first, second, pair[moving].astype(np.uint32))
    (folder / "room.json").write_text(json.dumps({"share": float(share), "removed": bool(share > _ROOM)}))
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = _SEED
    options.ransac.max_num_trials = 2000  # more are spent on pairs that show nothing in common
    pycolmap.geometric_verification(partial, two_view_geometry_options=options)
    os.replace(partial, folder / "verified.db")


def _map(folder: Path) -> None:
    partial = folder / "models.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = _SEED
    options.min_model_size = 3
    options.extract_colors = False
    # The defaults adjust all cameras anew for each tenth more; a fit's photographs are few and alike.
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.25
    options.ba_global_max_refinements = 2
    progress = folder / "mapping.progress"
    progress.write_bytes(b"")

    def placed() -> None:
        with open(progress, "ab") as file:
            file.write(b".")

    pycolmap.incremental_mapping(
        folder / "verified.db", folder / "images", partial, options=options, next_image_callback=placed
    )
    shutil.rmtree(folder / "models", ignore_errors=True)
    os.replace(partial, folder / "models")


if __name__ == "__main__":
    end_with_parent()  # two of them in one folder would spoil it
    run(Path(sys.argv[1]))
