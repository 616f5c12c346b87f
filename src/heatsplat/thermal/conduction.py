"""Heat that flows between Gaussians that touch: a state model whose temperatures even out with their neighbours'."""

from __future__ import annotations

import functools
import logging
import math
import warnings
from dataclasses import replace

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.derivatives import once_differentiable
from heatsplat.geometry.neighbours import neighbour_pairs
from heatsplat.same_bits import PIECE, total
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, ThermalModel
from heatsplat.thermal.coordinates import Clock
from heatsplat.thermal.wrapper import Wrapper

log = logging.getLogger(__name__)

LOG_FLOWS = (-12.0, 3.5)  # of κ per span; at the upper end neighbours are as good as one body
MOST_WITHIN = math.exp(LOG_FLOWS[1])  # of κ t, within the record
SOLVER_STEPS = 60  # conjugate gradients at that; their number grows with the root of κ t
SOLVER_TOLERANCE = 1e-6  # residual against the right-hand side, which bounds the error; float32 knows no better


class Conducting(Wrapper):
    """(I + κ t L)^{-1} T(t): the temperatures of another model after one implicit step of conduction over the time t.

    L is the Laplacian of the graph that joins every Gaussian with its nearest neighbours, divided by their mean number,
    so that κ is the rate, per observed span, at which a Gaussian exchanges heat with its neighbourhood. The step is that
    of backward Euler for dT/dt = -κ L T, split from the state's own law (Lie): first order in time, but stable at any κ
    and t, and no temperature leaves the range of all. Every Gaussian is evaluated, in view or not.

    **Convention:** time counts from the first training frame; before it nothing flows.

    Args:
        state: temperatures without conduction.
        neighbours: of a Gaussian.
        every: steps after which the graph is drawn anew; also when Gaussians have come or gone.
        flow: κ at the start, per span; positive.
        lr, lr_end: learning rate of log κ and the factor on it at the end of the run.

    Raises:
        ValueError: an option is out of its range.
    """

    inseparable = "heat flows between them, so the temperature of each depends on how many there are"
    own_beyond_record = "heat goes on flowing between neighbours"

    def __init__(
        self,
        state: ThermalModel,
        neighbours: int = 6,
        every: int = 200,
        flow: float = 0.05,
        lr: float = 0.01,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__({"state": state}, needs={"time"})
        if neighbours < 1 or every < 1 or flow <= 0:
            raise ValueError(
                f"neighbours and every must be at least 1 and flow positive, got {neighbours}, {every} and {flow}"
            )
        self.neighbours, self.every, self.lr, self.lr_end = neighbours, every, lr, lr_end
        self.log_flow = nn.Parameter(torch.tensor(math.log(flow)))
        self.clock = Clock()
        self.register_buffer("edges", torch.zeros(2, 0, dtype=torch.int64))  # each pair once
        self.register_buffer("joined", torch.zeros((), dtype=torch.int64))  # number of Gaussians in the graph
        self._due = False
        self._laplacian: tuple[Tensor, Tensor] | None = None  # of these edges

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        self.clock.prepare(scene)

    def on_step(self, step: int) -> None:
        super().on_step(step)
        self._due = self._due or step % self.every == 0

    def on_rows_changed(self) -> None:
        super().on_rows_changed()
        self.joined.zero_()  # as many may have come as went

    def features(self, splats: Splats, query: Query) -> Tensor:
        return query.rows(super().features(splats, replace(query, ids=None)))

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        return self.conducted(values, splats, query.time_s)

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        alone = super().temperature(splats, time_s)
        return None if alone is None else Query(ids).rows(self.conducted(alone[:, None], splats, time_s)[:, 0])

    def conducted(self, values: Tensor, splats: Splats, time_s: float | None) -> Tensor:
        """Values [N, C] of all Gaussians after they exchanged heat until ``time_s``."""
        spans = max(self.clock.spans(time_s), 0.0)
        self._join(splats)
        return _ImplicitStep.apply(values, spans * self.log_flow.clamp(*LOG_FLOWS).exp(), self._laplacian[1])

    @torch.inference_mode(False)  # a graph that is drawn for a picture serves those who differentiate, too
    @torch.no_grad()
    def _join(self, splats: Splats) -> None:
        """Draws the graph of nearest neighbours where there is none, or it is out of date."""
        count = len(splats)
        if self._due or int(self.joined) != count:
            pairs = neighbour_pairs(splats.means.detach(), self.neighbours)
            self.edges = pairs.T.contiguous().to(self.edges.device)
            self.joined.fill_(count)
            self._due = False
        kept, dtype = self._laplacian, splats.means.dtype
        if kept is None or kept[0] is not self.edges or kept[1].dtype != dtype:
            self._laplacian = self.edges, laplacian(self.edges, count).to(dtype)

    def effects(self) -> dict[str, dict]:
        flow = self.log_flow.detach().clamp(*LOG_FLOWS).exp().item()
        return super().effects() | {"conduction": {"neighbours": self.neighbours, "per_span": flow}}

    @property
    def cost(self) -> int:
        return super().cost + SOLVER_STEPS * (2 * self.neighbours + 10)


def laplacian(edges: Tensor, count: int) -> Tensor:
    """Degrees minus adjacency of ``count`` nodes, divided by the mean degree; [count, count], sparse rows (CSR).

    Args:
        edges: [2, E], each pair once.
    """
    i, j = edges
    degrees = torch.bincount(edges.flatten(), minlength=count).float()
    every = torch.arange(count, device=edges.device)
    places = torch.cat([torch.stack([i, j]), torch.stack([j, i]), torch.stack([every, every])], dim=1)
    values = torch.cat([-torch.ones(2 * len(i), device=edges.device), degrees])
    values = values / degrees.mean().clamp(min=1e-12)
    rows = torch.sparse_coo_tensor(places, values, (count, count), check_invariants=False).coalesce()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support", UserWarning)
        rows = rows.to_sparse_csr()
        # Products with 32-bit indices need no conversion; with sparse columns (COO) they take fifteen times as long.
        starts, columns = rows.crow_indices().int(), rows.col_indices().int()
        return torch.sparse_csr_tensor(starts, columns, rows.values(), rows.shape, check_invariants=False)


class _ImplicitStep(torch.autograd.Function):
    """x of (I + s L) x = f with L symmetric. Its gradient solves the same system: g = (I + s L)^{-1} v, ds = -g · L x.

    Beyond the record it is solved in double precision: an error of float32 counts s times as much.
    """

    @staticmethod
    def forward(ctx, right: Tensor, amount: Tensor, matrix: Tensor) -> Tensor:
        matrix = matrix.double() if amount > MOST_WITHIN else matrix
        solution = _conjugate_gradients(matrix, amount.item(), right.to(matrix.dtype))
        ctx.save_for_backward(solution, amount, matrix)
        return solution.to(right.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_solution: Tensor):
        solution, amount, matrix = ctx.saved_tensors
        v_right = _conjugate_gradients(matrix, amount.item(), v_solution.contiguous().to(matrix.dtype))
        v_amount = -total(v_right * (matrix @ solution)).to(amount.dtype) if ctx.needs_input_grad[1] else None
        return v_right.to(v_solution.dtype), v_amount, None


def _conjugate_gradients(matrix: Tensor, amount: float, right: Tensor) -> Tensor:
    """x of (I + amount · matrix) x = right, [N, C]; each column by its own conjugate gradients.

    They start from ``right``: the residual has no mean then, whose eigenvalue is by far the smallest where much flows.
    """
    if amount == 0.0:
        return right.clone()
    solution = right.clone()
    residual = right - solution - amount * (matrix @ solution)
    direction, squared = residual.clone(), _products(residual, residual)
    enough = SOLVER_TOLERANCE**2 * _products(right, right)
    # Twice as many as it takes where Gaussians have about as many neighbours each.
    for _ in range(math.ceil(2 * SOLVER_STEPS * math.sqrt(max(1.0, amount / MOST_WITHIN)))):
        if bool((squared <= enough).all()):
            break
        image = direction + amount * (matrix @ direction)
        step = squared / _products(direction, image).clamp(min=torch.finfo(right.dtype).tiny)
        solution = solution + step * direction
        residual = residual - step * image
        before, squared = squared, _products(residual, residual)
        direction = residual + (squared / before.clamp(min=torch.finfo(right.dtype).tiny)) * direction
    if bool((squared > enough).any()):
        _warn_of_error()
    return solution


def _products(one: Tensor, other: Tensor) -> Tensor:
    """Scalar products of columns [N, C] with those of another tensor, [C]."""
    products = one * other
    if products.numel() < PIECE:
        return products.sum(0)
    return torch.stack([total(column) for column in products.unbind(1)])


@functools.cache  # once
def _warn_of_error() -> None:
    log.warning(
        "the heat that flows between Gaussians was not solved to %g of their temperatures: what is shown is less even than "
        "it should be, most where much time has passed",
        SOLVER_TOLERANCE,
    )
