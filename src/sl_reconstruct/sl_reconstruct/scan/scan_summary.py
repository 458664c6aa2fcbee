"""What a scan measured and refused: the one source of messages, reports and pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from sl_projector.sequence.stack import Stack
from sl_reconstruct.cloud.cloud import Cloud, median
from sl_reconstruct.cloud.cloud_writer import cloud_hash
from sl_reconstruct.reconstruction.reconstructor_cache import Product


@dataclass(frozen=True)
class ScanSummary:
    """A scan in numbers; names and units are those of ``ScanReport.msg``.

    Parameters
    ----------
    scan_id : int
        The scan.
    sequence : str
        Name of the sequence.
    rows, columns : int
        Size of the organised cloud.
    points, lit_positions : int
        Points in the cloud, and positions that could hold one: points and refused ones.
    refused : mapping of str to int
        Positions without a point, by reason.
    median_sigma_m : float
        Median of the stated 1-sigma of z, metres.
    figures : mapping of str to float
        Quality figures by name (`Figures`), of edges and rays; a message carries those of edges.
    calibration_hash, settings_hash, cloud_hash : str
        What the cloud was made with, and its points; sha256.
    attempts : int, optional
        Projections made; None where the scan was not live, as for all that follows.
    attempt_messages : tuple of str, optional
        Why each attempt but the last was thrown away.
    acquisition_s, processing_s : float, optional
        First exposure to last image, last image to published cloud, seconds.
    """

    scan_id: int
    sequence: str = ""
    rows: int = 0
    columns: int = 0
    points: int = 0
    lit_positions: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    median_sigma_m: float = 0.0
    figures: Mapping[str, float] = field(default_factory=dict)
    calibration_hash: str = ""
    settings_hash: str = ""
    cloud_hash: str = ""
    attempts: int | None = None
    attempt_messages: tuple[str, ...] | None = None
    acquisition_s: float | None = None
    processing_s: float | None = None

    @classmethod
    def of(cls, product: Product, stack: Stack, **live: Any) -> ScanSummary:
        """Summarise a cloud.

        Parameters
        ----------
        product : Product
            The cloud and what it was made with.
        stack : Stack
            The images that it was made of; they may have been let go.
        **live
            What only a live scan knows, by name.
        """
        cloud = product.cloud
        rows, columns = cloud.points.shape
        return cls(
            scan_id=stack.scan_id,
            sequence=stack.sequence.name,
            rows=rows,
            columns=columns,
            points=cloud.present,
            lit_positions=cloud.lit,
            refused=dict(cloud.refused),
            median_sigma_m=cloud.median_sigma_m,
            figures=_figures(cloud),
            calibration_hash=product.calibration_hash,
            settings_hash=product.settings_hash,
            cloud_hash=cloud_hash(cloud.points),
            **live,
        )

    def to_dict(self) -> dict[str, Any]:
        """All that is known, as ``report.json`` has it."""
        known = {item.name: getattr(self, item.name) for item in fields(self)}
        present = self.points / self.lit_positions if self.lit_positions else 0.0
        return {
            **{name: value for name, value in known.items() if value is not None},
            "present_fraction": present,
        }


def _figures(cloud: Cloud) -> dict[str, float]:
    """Quality figures by name; the residuals of the rays where there are any."""
    figures = {item.name: getattr(cloud.figures, item.name) for item in fields(cloud.figures)}
    figures["bound_ratio"] = cloud.figures.bound_ratio
    for name, gap in (("median_gap_m", cloud.gap_m), ("median_gap_px", cloud.gap_px)):
        if gap is not None:
            figures[name] = median(gap)
    return figures
