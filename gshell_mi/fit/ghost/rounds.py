"""Rounds of the ghost: what false openings hide is found once these are known.

Where the ghost opens the wrong place it sees through it, and learns nothing of what is beside and behind.
With a trouser leg open at its back, the cap at its end explains the few views that see in as well as the
dark inside, which is not there. So if some of what it opens is not justified, it is trained once more, from
where it is opaque there and open where that is justified; and as long as that finds further openings, again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from .justified import close_unjustified, open_unjustified
from .opening import clean_opacity
from .radiance_ghost import RadianceGhost

#: Logit, at most, of what has been justified before.
_OPEN = -1.0


def find_openings(ghost: RadianceGhost, vertices: np.ndarray, faces: np.ndarray,
                  train: Callable[[int], None]) -> np.ndarray:
    """Where the images justify an opening.

    Args:
        ghost: after its training; it is trained further.
        vertices, faces: (V, 3) and (F, 3) of its template.
        train: does all steps of its training; told for which time, after the first, from 1.

    Returns:
        (V,) opacity logits, negative at openings.
    """
    gain, clean = ghost.config.ghost_gain, partial(clean_opacity, vertices=vertices, faces=faces,
                                                   min_area=ghost.config.ghost_min_area)
    # At a gain of 0 nothing will be justified.
    rounds = ghost.config.ghost_rounds if gain > 0 else 0
    opened, unjustified = (np.zeros(len(vertices), bool) for _ in range(2))
    for trained_again in range(rounds + 1):
        if trained_again:
            ghost.begin_again(unjustified, opened)
            train(trained_again)
        proposed = clean(ghost.smoothed_logits())
        proposed = np.where(opened, np.minimum(proposed, _OPEN), proposed)
        logits = proposed
        for judge in (close_unjustified, open_unjustified):
            logits = clean(judge(logits, faces, ghost.image_error, gain))
        # A close call may come out otherwise now.
        logits = np.where(opened, np.minimum(logits, _OPEN), logits)
        unjustified |= (proposed <= 0) & (logits > 0)
        # Rims differ a little each time.
        further = clean(np.where((logits <= 0) & ~opened, -1.0, 1.0)) <= 0
        opened = logits <= 0
        if not unjustified.any() or (trained_again and not further.any()):
            break
    return logits
