"""Which pairs of photographs may be believed: cycle consistency of relative poses.

Repeated objects make pairs with hundreds of inliers and a wrong relative pose. One pair cannot show it; a loop can:
rotations around a triplet of cameras must multiply to the identity (Zach, Klopschitz, Pollefeys, "Disambiguating visual
relations using loop constraints", CVPR 2010).
"""

from collections.abc import Callable

import numpy as np

from catacaustics.capture.sfm import RelativePose
from catacaustics.geometry import rotation_angle
from catacaustics.shapes import Bool, Float

TOLERANCES = (np.radians(5), np.radians(7), np.radians(9))
"""Most rotation error around a consistent triplet: the strictest that ties the photographs together is taken. Between a
pair's rotation and the voted ones 1.6 times as much, because errors add up along the tree."""


def triplets(edges: list[RelativePose]) -> tuple[np.ndarray, np.ndarray]:
    """All triplets of photographs with three edges.

    Returns:
        Indices of their edges (m, 3), for i < j < k in the order ij, jk, ik; and the rotation error around each (m,),
        in radians.
    """
    numbers: dict[tuple[int, int], list[int]] = {}
    after: dict[int, set[int]] = {}
    for n, e in enumerate(edges):
        numbers.setdefault((e.first, e.second), []).append(n)
        after.setdefault(e.first, set()).add(e.second)
    rows = [
        (a, b, c)
        for i, j in numbers
        for k in after.get(j, ())
        if (i, k) in numbers
        for a in numbers[i, j]
        for b in numbers[j, k]
        for c in numbers[i, k]
    ]
    index = np.array(rows, int).reshape(-1, 3)
    r = np.array([e.rotation for e in edges]).reshape(-1, 3, 3)
    around = r[index[:, 1]] @ r[index[:, 0]] @ np.swapaxes(r[index[:, 2]], 1, 2)
    return index, rotation_angle(around)


def triplet_support(edges: list[RelativePose], tolerance: float = TOLERANCES[0]) -> Float[np.ndarray, "n"]:
    """How much consistent triplets speak for each edge: the sum over them of the inliers of the weakest other edge."""
    index, error = triplets(edges)
    inliers = np.array([len(e.matches) for e in edges], float)
    index = index[error < tolerance]
    support = np.zeros(len(edges))
    for column in range(3):
        others = index[:, [c for c in range(3) if c != column]]
        np.add.at(support, index[:, column], inliers[others].min(1))
    return support


def cycle_score(edges: list[RelativePose]) -> float:
    """How well all triplets close, weighted by inliers; it peaks at the true focal length."""
    index, error = triplets(edges)
    inliers = np.array([len(e.matches) for e in edges], float)
    return float((inliers[index].min(1) * np.exp(-((error / np.radians(3)) ** 2))).sum()) if len(index) else 0.0


def search_focal(score: Callable[[float], float]) -> tuple[float, bool]:
    """Focal length as a multiple of the longer side that maximises `score`: a coarse grid over lenses from 90 to 25
    degrees, then a fine one.

    Returns:
        The factor, and whether anything spoke for it; 1.2, COLMAP's default, where nothing did.
    """
    coarse = np.geomspace(0.5, 2.2, 12)
    scores = [score(f) for f in coarse]
    best = int(np.argmax(scores))
    if scores[best] <= 0:
        return 1.2, False
    step = coarse[1] / coarse[0]
    fine = coarse[best] * step ** np.array([-0.67, -0.33, 0.33, 0.67])
    candidates = [(scores[best], coarse[best]), *((score(f), f) for f in fine)]
    return float(max(candidates)[1]), True


def _spanning_tree(order: np.ndarray, first: np.ndarray, second: np.ndarray, n: int) -> list[int]:
    """Edges of the spanning forest that takes edges in the given order (Kruskal)."""
    parent = list(range(n))

    def root(x: int) -> int:
        while parent[x] != x:
            parent[x] = parent[parent[x]]
            x = parent[x]
        return x

    tree = []
    for e in order:
        a, b = root(int(first[e])), root(int(second[e]))
        if a != b:
            parent[a] = b
            tree.append(int(e))
    return tree


def _walk(tree: list[int], first: np.ndarray, second: np.ndarray, relative: np.ndarray, n: int) -> np.ndarray:
    """Rotations (n, 3, 3) along a spanning forest, each tree starting at the identity."""
    neighbors: list[list[tuple[int, np.ndarray]]] = [[] for _ in range(n)]
    for e in tree:
        neighbors[first[e]].append((second[e], relative[e]))
        neighbors[second[e]].append((first[e], relative[e].T))
    rotations, seen = np.tile(np.eye(3), (n, 1, 1)), np.zeros(n, bool)
    for start in range(n):
        if seen[start]:
            continue
        seen[start] = True
        stack = [start]
        while stack:
            x = stack.pop()
            for y, r in neighbors[x]:
                if not seen[y]:
                    seen[y] = True
                    rotations[y] = r @ rotations[x]
                    stack.append(y)
    return rotations


def vote_rotations(
    edges: list[RelativePose],
    weights: Float[np.ndarray, "m"],
    n: int,
    tolerance: float = 1.6 * TOLERANCES[0],
    trials: int = 400,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "n 3 3"], Bool[np.ndarray, "m"]]:
    """RANSAC over spanning trees: the rotations that most edges, by weight, agree with.

    Each trial draws a spanning tree in which heavy edges are likelier (weights to the power 2, Gumbel noise), walks
    it, and sums the weights of the edges within `tolerance`.

    Returns:
        World-to-camera rotations, and which edges agree with them.
    """
    rng = np.random.default_rng(seed)
    first, second = (np.array([getattr(e, side) for e in edges], int) for side in ("first", "second"))
    relative = np.array([e.rotation for e in edges]).reshape(-1, 3, 3)
    best, agree = np.tile(np.eye(3), (n, 1, 1)), np.zeros(len(edges), bool)
    most = -1.0
    for _ in range(trials if len(edges) else 0):
        order = np.argsort(-(2 * np.log(weights) + rng.gumbel(size=len(weights))))
        rotations = _walk(_spanning_tree(order, first, second, n), first, second, relative, n)
        error = rotation_angle(relative @ rotations[first] @ np.swapaxes(rotations[second], 1, 2))
        good = error < tolerance
        if weights[good].sum() > most:
            most, best, agree = weights[good].sum(), rotations, good
        if good.all():
            break
    return best, agree


def consistent_edges(edges: list[RelativePose], n: int, tolerance: float = TOLERANCES[0]) -> Bool[np.ndarray, "m"]:
    """Edges that close at least one triplet and agree with the rotations that most edges agree with.

    A graph without any triplet (three photographs in a row) is believed as it is.
    """
    if not len(triplets(edges)[0]):
        return np.ones(len(edges), bool)
    support = triplet_support(edges, tolerance)
    closed = np.flatnonzero(support > 0)
    inliers = np.array([len(edges[e].matches) for e in closed], float)
    _, agree = vote_rotations([edges[e] for e in closed], inliers * (1 + support[closed] / 50), n, 1.6 * tolerance)
    keep = np.zeros(len(edges), bool)
    keep[closed[agree]] = True
    return keep


def rigid_group(edges: list[RelativePose], tolerance: float = TOLERANCES[0]) -> set[int]:
    """The largest group of photographs that triplets tie together rigidly.

    Relative poses have no scale: two groups that share one photograph, or are joined by one pair, may each be right and
    stand in any size beside each other. Triplets that share two photographs fix it, and so do groups that share two.
    Without any triplet all photographs are one group.
    """
    index, error = triplets(edges)
    groups = [{edges[e].first for e in row} | {edges[e].second for e in row} for row in index[error < tolerance]]
    if not groups:
        return {i for e in edges for i in (e.first, e.second)}
    merged = True
    while merged:
        merged, old, groups = False, groups, []
        for group in old:
            partner = next((g for g in groups if len(g & group) >= 2), None)
            if partner is None:
                groups.append(set(group))
            else:
                partner |= group
                merged = True
    return max(groups, key=len)


def believable_pairs(edges: list[RelativePose], n: int) -> list[RelativePose]:
    """One relative pose a pair, of the pairs that close loops and tie the largest group of photographs together.

    The strictest of `TOLERANCES` whose group has 90 % of the photographs that the largest group has is taken.
    """
    best: list[tuple[int, list[RelativePose]]] = []
    for tolerance in TOLERANCES:
        chosen: dict[tuple[int, int], RelativePose] = {}
        for edge, good in zip(edges, consistent_edges(edges, n, tolerance), strict=True):
            pair = edge.first, edge.second
            if good and (pair not in chosen or len(edge.matches) > len(chosen[pair].matches)):
                chosen[pair] = edge
        group = rigid_group(list(chosen.values()), tolerance)
        best.append((len(group), [e for e in chosen.values() if {e.first, e.second} <= group]))
    largest = max(size for size, _ in best)
    return next(pairs for size, pairs in best if size >= 0.9 * largest)


def strongest(matches: dict[tuple[int, int], np.ndarray], most: int = 120) -> dict[tuple[int, int], np.ndarray]:
    """The pairs with most matches."""
    return dict(sorted(matches.items(), key=lambda item: -len(item[1]))[:most])
