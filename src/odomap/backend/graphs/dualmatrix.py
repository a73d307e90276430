"""The matrix whose definiteness proves poses to be the best.

With X = [R_1 t_1 … R_N t_N] the chordal cost is f = tr(X M Xᵀ), and with multipliers Λ_i = Λ_iᵀ of
the conditions R_iᵀ R_i = I the matrix of the proof (`certificate`) is S = M − diag(Λ_i, 0).

Where the origin of a node lies is a choice: t_i = t'_i + R_i a_i does not change the cost, nor S
with positions eliminated if they are the best, but what rounding does, which grows with lengths in

    t_j − t_i − R_i t̃ = t'_j + R_j a_j − t'_i − R_i (t̃ + a_i).

Σ τ |t̃ + a_i|² + Σ τ |a_j|² is least at a_i = −Σ τ t̃ / Σ τ, the first sum over edges from i, the
second over all at i. The world, from which priors are edges, thereby moves to their middle, so that
coordinates of millions of metres cancel before anything is squared.

How stiff a node is, D_i = tr(M_ii) / d of its rotation, is what its eigenvalues and its rounding
are measured by, as information may differ by any factor between nodes. O(N + E).

Reference: D. M. Rosen, L. Carlone, A. S. Bandeira, J. J. Leonard, "SE-Sync: A certifiably correct
algorithm for synchronization over the special Euclidean group", IJRR 38(2-3), 2019.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from odomap.backend.graphs.components import connected_components
from odomap.backend.sparse.blockcholesky import BlockCholesky
from odomap.backend.sparse.blocks import BlockPattern
from odomap.backend.sparse.lanczos import largest_eigenvalue, largest_ritz_value
from odomap.kernels import kernel

__all__ = ["DualMatrix", "IsotropicEdges", "warm_up"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Bool = NDArray[np.bool_]


class IsotropicEdges(NamedTuple):
    """Edges (E,) from first to second, measured Zs (E, m, m), with precisions κ and τ."""

    first: Index
    second: Index
    Zs: Array
    kappa: Array
    tau: Array


@dataclass(frozen=True)
class DualMatrix:
    """S with the position of one node per component struck out, and what belongs to it.

    Attributes:
        pattern: of blocks of d + 1, the rotation and the position of each node.
        values: of S.
        gradient: (N, d, d + 1) X S, half the gradient of f by R and t'; 0 where struck out.
        trace: Σ tr Λ_i.
        space: d.
        stiffness: (N,) D_i.
        offset: (N, d) a_i.
    """

    pattern: BlockPattern
    values: Array
    gradient: Array
    trace: float
    space: int
    stiffness: Array
    offset: Array

    @classmethod
    def at(cls, edges: IsotropicEdges, Ts: Array) -> "DualMatrix":
        """Return the matrix at poses (N, m, m) whose rotations are exact."""
        n, d = len(Ts), Ts.shape[1] - 1
        first, second, tau = edges.first, edges.second, edges.tau
        pattern = BlockPattern.of(np.full(n, d + 1), first, second)
        pair = pattern.pair_start[pattern.pair_of(first, second)]
        values, G = np.zeros(pattern.num_values), np.zeros((n, d, d + 1))
        offset = _offsets(n, edges)
        _cost_matrix(*edges, Ts, offset, pair, pattern.diagonal_start, values, G)
        rotations = pattern.diagonal.reshape(n, d + 1)[:, :d]
        stiffness = values[rotations].mean(axis=1)
        stiffness[stiffness <= 0.0] = min(stiffness[stiffness > 0.0], default=1.0)
        trace = _subtract_multipliers(Ts, pattern.diagonal_start, values, G)
        moves = connected_components(n, first[tau > 0.0], second[tau > 0.0])
        struck = np.zeros(n, np.bool_)
        struck[np.unique(moves, return_index=True)[1]] = True
        ends = pattern.first, pattern.second
        _strike_out(*ends, struck, d, pattern.pair_start, pattern.diagonal_start, values)
        G[struck, :, d] = 0.0
        return cls(pattern, values, G, trace, d, stiffness, offset)

    @property
    def size(self) -> int:
        """Rows of S̃."""
        return len(self.pattern.sizes) * self.space

    def shifted(self, shift: Array) -> Array:
        """Return the values of S + diag(shift_i I, 0), shift (N,)."""
        values = self.values.copy()
        at = self.pattern.diagonal.reshape(-1, self.space + 1)[:, : self.space]
        values[at] += shift[:, None]
        return values

    def norm(self) -> float:
        """Return the largest eigenvalue of the rotations' part of S, which bounds that of S̃.

        1 if it is zero, as where edges measure nothing but where nodes lie.
        """
        multiply = self.pattern.multiply
        norm = largest_eigenvalue(
            lambda x: self._rotations(multiply(self.values, self._with_positions(x))),
            self.size,
            tolerance=0.1,
        )
        return norm if norm > 0.0 else 1.0

    def smallest_eigenvalue(self, factor: BlockCholesky, shift: float, scale: Array) -> float:
        """Return λ_min of D^−½ S̃ D^−½, D = scale (N,), given the factor of S + shift diag(D, 0).

        What Lanczos' method leaves open is taken off: 1e-8 of λ_min + shift, or more if it is slow.
        """
        root = np.repeat(np.sqrt(scale), self.space)
        inverse, error = largest_ritz_value(
            lambda x: root * self._rotations(factor.solve(self._with_positions(root * x))),
            self.size,
        )
        return 1.0 / (inverse + error) - shift

    def decrease(self, factor: BlockCholesky) -> float:
        """Return tr(G S⁻¹ Gᵀ), what the step X − G S⁻¹ takes off tr(X S Xᵀ)."""
        rows = np.ascontiguousarray(np.moveaxis(self.gradient, 1, 0)).reshape(self.space, -1)
        return float(sum(np.sum(row * factor.solve(row)) for row in rows))

    def _with_positions(self, x: Array) -> Array:
        """Return a vector of rotations (dN,) with zeros for positions put between."""
        y = np.zeros((len(self.pattern.sizes), self.space + 1))
        y[:, : self.space] = x.reshape(-1, self.space)
        return y.reshape(-1)

    def _rotations(self, y: Array) -> Array:
        """Return a vector without the entries of positions."""
        return y.reshape(-1, self.space + 1)[:, : self.space].reshape(-1)


def _offsets(num_nodes: int, edges: IsotropicEdges) -> Array:
    """Return a_i (N, d) = −Σ τ t̃ / Σ τ."""
    d = edges.Zs.shape[1] - 1
    moment, mass = np.zeros((num_nodes, d)), np.zeros(num_nodes)
    np.add.at(moment, edges.first, edges.tau[:, None] * edges.Zs[:, :d, d])
    np.add.at(mass, edges.first, edges.tau)
    np.add.at(mass, edges.second, edges.tau)
    return -moment / np.where(mass > 0.0, mass, 1.0)[:, None]


@kernel
def _cost_matrix(
    first: Index,
    second: Index,
    Zs: Array,
    kappa: Array,
    tau: Array,
    Ts: Array,
    offset: Array,
    pair: Index,
    diagonal: Index,
    values: Array,
    G: Array,
) -> None:
    """M += V Vᵀ, G += X V Vᵀ; V = √κ (−R̃ at i, I at j) and √τ (p at i, q at j)."""
    d = Zs.shape[1] - 1
    m = d + 1
    p, q, row = np.empty(m), np.empty(m), np.empty(m)
    p[d], q[d] = -1.0, 1.0
    for e in range(len(first)):
        i, j, k, w = first[e], second[e], kappa[e], tau[e]
        Z = Zs[e]
        for a in range(d):  # p = (−(t̃ + a_i), −1), q = (a_j, 1)
            p[a], q[a] = -(Z[a, d] + offset[i, a]), offset[j, a]
        for a in range(m):
            for b in range(m):
                values[diagonal[i] + a * m + b] += w * p[a] * p[b]
                values[diagonal[j] + a * m + b] += w * q[a] * q[b]
                values[pair[e] + (a * m + b if i < j else b * m + a)] += w * p[a] * q[b]
        for a in range(d):
            values[diagonal[j] + a * (m + 1)] += k
            for b in range(d):
                turned = 0.0
                for c in range(d):
                    turned += Z[a, c] * Z[b, c]
                values[diagonal[i] + a * m + b] += k * turned
                values[pair[e] + (a * m + b if i < j else b * m + a)] -= k * Z[a, b]
        for a in range(d):
            for b in range(m):  # row a of R_j − R_i R̃ and t_j − t_i − R_i t̃, weighted
                row[b] = Ts[j, a, b] - (Ts[i, a, d] if b == d else 0.0)
                for c in range(d):
                    row[b] -= Ts[i, a, c] * Z[c, b]
                row[b] *= w if b == d else k
            for b in range(d):
                G[j, a, b] += row[b] + row[d] * q[b]
                G[i, a, b] += row[d] * p[b]
                for c in range(d):
                    G[i, a, b] -= row[c] * Z[b, c]
            G[j, a, d] += row[d]
            G[i, a, d] -= row[d]


@kernel
def _subtract_multipliers(Ts: Array, diagonal: Index, values: Array, G: Array) -> float:
    """S_ii −= Λ_i = sym(R_iᵀ G_i) and G_i −= R_i Λ_i; returns Σ tr Λ_i."""
    d = Ts.shape[1] - 1
    m = d + 1
    L = np.empty((d, d))
    trace = 0.0
    for i in range(len(Ts)):
        for a in range(d):
            for b in range(d):
                L[a, b] = 0.0
                for c in range(d):
                    L[a, b] += 0.5 * (Ts[i, c, a] * G[i, c, b] + Ts[i, c, b] * G[i, c, a])
        for a in range(d):
            trace += L[a, a]
            for b in range(d):
                values[diagonal[i] + a * m + b] -= L[a, b]
                for c in range(d):
                    G[i, a, b] -= Ts[i, a, c] * L[c, b]
    return trace


@kernel
def _strike_out(
    first: Index,
    second: Index,
    struck: Bool,
    row: int,
    pair: Index,
    diagonal: Index,
    values: Array,
) -> None:
    """Make `row` of each block struck, and its column, those of the unit matrix."""
    m = row + 1
    for i in range(len(struck)):
        if struck[i]:
            for a in range(m):
                values[diagonal[i] + a * m + row] = 0.0
                values[diagonal[i] + row * m + a] = 0.0
            values[diagonal[i] + row * m + row] = 1.0
    for p in range(len(first)):
        for a in range(m):
            if struck[first[p]]:
                values[pair[p] + row * m + a] = 0.0
            if struck[second[p]]:
                values[pair[p] + a * m + row] = 0.0


def warm_up() -> None:
    """Compile the kernels of this module."""
    Ts = np.stack([np.eye(3), np.eye(3)])
    one = np.ones(1)
    edges = IsotropicEdges(np.zeros(1, np.int64), np.ones(1, np.int64), Ts[:1], one, one)
    DualMatrix.at(edges, Ts)
