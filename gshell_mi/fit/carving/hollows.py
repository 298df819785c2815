"""What to hollow out of a visual hull: a minimum cut between outside and inside of what a fog shows.

Both a fold of a garment and its inside are empty and in sight, but only the fold is outside of the template:
the inside lies behind an opening that the openings stage has found. So the outside starts at the hull, the
inside behind the openings and where nothing is seen, and the boundary runs where cutting is cheap: through
what is opaque (Boykov and Kolmogorov, ICCV 2003).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from ..surface import Surface

#: Optical depth per cell at which a cut costs 1 / e of what it does in empty space, and the least cost.
_DEPTH, _LEAST = 0.4, 0.03

#: What it costs to leave outside a vertex that is opaque or not seen: as much as one cut in empty space.
_HIDDEN = 1.0

#: A vertex is opaque from this opacity of a cell on.
_OPAQUE = 0.5

#: Vertices up to this many cells below an opening are inside, at this cost.
_LID, _LID_COST = 1.6, 20.0

#: Hollows that are nowhere deeper than this, in cells, stay to the refinement.
_SHALLOW = 1.5

#: Standard deviations, in cells, that smooth the opacity before the cut and the hollows' distance after it.
_OPACITY_BLUR, _DISTANCE_BLUR = 0.5, 0.5

#: Flows are integers.
_UNIT = 1000


def hollows(hull: np.ndarray, msdf: np.ndarray, opacity: np.ndarray, seen: np.ndarray) -> np.ndarray | None:
    """What to carve from a visual hull.

    Args:
        hull: (n, n, n) signed distances to the hull, in cells.
        msdf: (n, n, n) negative at its openings.
        opacity: (n, n, n) of a cell's length.
        seen: (n, n, n) whether a vertex is seen.

    Returns:
        (n, n, n) signed distances, in cells, positive in the hollows, -inf far from them: the carved solid's
        are the larger of these and the hull's. None if there is nothing to carve, or nothing would be left.
    """
    inside = hull < 0
    lid = inside & (msdf < 0) & (hull > -_LID)
    solid = _minimum_cut(inside, lid, opacity, ~seen | (opacity > _OPAQUE))
    air = ndimage.binary_opening(~solid, ndimage.generate_binary_structure(3, 1))
    hollow = inside & air
    hollow = ndimage.binary_propagation(hollow & (hull < -_SHALLOW), mask=hollow)
    air = hollow | ~inside
    if not hollow.any() or air.all():
        return None
    distance = ndimage.distance_transform_edt(air) - ndimage.distance_transform_edt(~air)
    near = ndimage.binary_dilation(hollow, iterations=3)
    return np.where(near, ndimage.gaussian_filter(distance, _DISTANCE_BLUR), -np.inf)


def hollowed(surface: Surface, distance: np.ndarray) -> Surface:
    """A surface with hollows carved out of its solid.

    Args:
        surface: with its hull.
        distance: signed distances to the hollows, in cells, positive inside.
    """
    deep = surface.lattice.spacing * distance.ravel()
    sdf, hull = (
        np.maximum(field, deep).astype(np.float32) for field in (surface.fields.sdf, surface.hull_distance)
    )
    return replace(surface.with_fields(sdf=sdf), hull=hull)


def _minimum_cut(inside: np.ndarray, lid: np.ndarray, opacity: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Whether each vertex belongs to the solid."""
    depth = ndimage.gaussian_filter(-np.log1p(-np.minimum(opacity, 1 - 1e-6)), _OPACITY_BLUR)
    count = int(inside.sum())
    node = np.full(inside.shape, -1)
    node[inside] = np.arange(count)
    source, sink = count, count + 1
    to_sink = np.zeros(count)
    edges = []
    for axis in range(3):
        low, high = ([slice(None)] * 3 for _ in range(2))
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        low, high = tuple(low), tuple(high)
        both = inside[low] & inside[high]
        cost = np.exp(-(depth[low] + depth[high])[both] / (2 * _DEPTH)) + _LEAST
        first, second = node[low][both], node[high][both]
        edges += [(first, second, cost), (second, first, cost)]
        for here, there in ((low, high), (high, low)):
            # Nothing is lost where the hull itself is the boundary, least of all at a lid.
            border = inside[here] & ~inside[there] & ~lid[here]
            cost = np.exp(-depth[here][border] / (2 * _DEPTH)) + _LEAST
            np.add.at(to_sink, node[here][border], cost)
    from_source = _HIDDEN * hidden[inside] + _LID_COST * lid[inside]
    every = np.arange(count)
    edges += [(np.full(count, source), every, from_source), (every, np.full(count, sink), to_sink)]
    start, end, capacity = (np.concatenate(part) for part in zip(*edges, strict=True))
    capacity = np.rint(capacity * _UNIT).astype(np.int32)
    shape = (count + 2, count + 2)
    graph = coo_matrix((capacity, (start, end)), shape).tocsr()
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    solid = np.zeros(count + 2, bool)
    solid[reached] = True
    result = np.zeros(inside.shape, bool)
    result[inside] = solid[:count]
    return result
