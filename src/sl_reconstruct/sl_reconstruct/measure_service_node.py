"""The service `measure`: the last cloud, or one from a file, measured by the library."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sl_common import topics
from sl_common.base_node import RigNode
from sl_common.errors import StackError
from sl_reconstruct.cloud.cloud_reader import read_cloud
from sl_reconstruct.measure.request import Answer, MeasurementRequest, measure_cloud


class _Source(NamedTuple):
    name: str
    points: NDArray[Any]


class MeasureService:
    """Offers `measure` for a node that makes clouds.

    Parameters
    ----------
    node : RigNode
        Whose service this is; measuring runs in its workers.
    """

    def __init__(self, node: RigNode) -> None:
        self._node = node
        self._last: _Source | None = None
        node.serve_work(topics.MEASURE, self._answer)

    def remember(self, points: NDArray[Any], stamp_ns: int) -> None:
        """Take a cloud that was just published.

        Parameters
        ----------
        points : ndarray, (rows, columns), structured float32
            The cloud; it must not be written to any more.
        stamp_ns : int
            Start of its scan's first exposure.
        """
        self._last = _Source(f"scan {stamp_ns // 10**9}.{stamp_ns % 10**9:09d}", points)

    def _answer(self, request: Any, response: Any) -> None:
        """Fill the response; what is not known stays NaN."""
        response.kind = request.kind
        response.value = response.uncertainty = math.nan
        source = self._source(request.cloud_file)
        response.cloud = source.name
        _fill(response, measure_cloud(_order(request), source.points))

    def _source(self, file: str) -> _Source:
        if file:
            return _Source(file, read_cloud(file))
        if self._last is None:
            raise StackError("no cloud yet; expected a scan before, or cloud_file")
        return self._last


def _order(request: Any) -> MeasurementRequest:
    return MeasurementRequest(
        request.kind, tuple(request.region_m), request.reference_file, request.level,
        request.quantity, tuple(request.tolerance),
    )  # fmt: skip


def _fill(response: Any, answer: Answer) -> None:
    found, quantities = answer.found, answer.quantities
    response.success, response.message = True, answer.text
    response.kind, response.verdict = found.kind, answer.verdict
    response.value, response.uncertainty = float(found.value), float(found.uncertainty)
    response.unit = found.unit
    response.names = [q.name for q in quantities]
    response.values = [float(q.value) for q in quantities]
    response.uncertainties = [float(q.uncertainty) for q in quantities]
    response.units = [q.unit for q in quantities]
    response.points, response.set_aside = found.points, found.set_aside
    response.degrees_of_freedom = max(found.dof, 0)
    response.residual_rms_m, response.inflation = found.rms_m, found.inflation
    if found.region is not None:
        response.region_used_m = np.ravel(found.region.corners_m).tolist()
