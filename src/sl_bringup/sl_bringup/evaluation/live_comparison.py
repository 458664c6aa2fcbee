"""What the live graph said of the scans in a recording, to be compared with an evaluation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from sl_bringup.bag.bags import Bag
from sl_common.topics import REPORT
from sl_reconstruct.messages import report_from_msg
from sl_reconstruct.scan.scan_summary import ScanSummary


class LiveResults:
    """Hashes of the live clouds by scan.

    Parameters
    ----------
    bag : Bag
        The recording; without `REPORT` in it nothing can be compared.
    """

    def __init__(self, bag: Bag) -> None:
        self._reports: defaultdict[int, list[ScanSummary]] = defaultdict(list)
        if bag.has(REPORT):
            for recorded in bag.messages(REPORT, quick=True):
                summary = report_from_msg(recorded.message)
                self._reports[summary.scan_id].append(summary)

    def settings_hash(self, scan_id: int) -> str:
        """Settings of the scan's live cloud; empty where there is none."""
        live = self._reports.get(scan_id, [])
        return live[-1].settings_hash if live else ""

    def compare(self, report: Mapping[str, Any]) -> dict[str, Any]:
        """Compare a scan's report with the live one.

        Returns
        -------
        dict
            ``agrees``: true (the same bits), false, or none where it cannot be said; ``told``.
        """
        live = self._reports.get(report["scan_id"], [])
        if not live:
            return {"agrees": None, "told": "the recording holds no live result of this scan"}
        if (same := report["cloud_hash"]) in [summary.cloud_hash for summary in live]:
            told = "the live cloud has the same hash"
            return {"agrees": True, "told": told, "cloud_hash": same}
        last = live[-1]
        found: dict[str, Any] = {"agrees": None, "cloud_hash": last.cloud_hash}
        for what, told in (("calibration", "another calibration"), ("settings", "other settings")):
            if getattr(last, f"{what}_hash") != report[f"{what}_hash"]:
                return {**found, "told": f"the live cloud was made with {told}"}
        told = "the live cloud differs, with the same calibration and settings (other software?)"
        return {**found, "agrees": False, "told": told}
