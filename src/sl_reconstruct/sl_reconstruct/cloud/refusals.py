"""Why an edge position holds no point: the codes of refusal maps."""

from __future__ import annotations

from enum import IntEnum


class Reason(IntEnum):
    """One code for each (camera row, column boundary)."""

    PRESENT = 0
    #: Not expected: no lit pixel of the row shows this part of the pattern.
    UNLIT = 1
    #: Lit and unlit differ too little.
    CONTRAST = 2
    #: A pixel under the edge is saturated.
    SATURATION = 3
    #: The Gray code beside the edge and the edge's own pattern name different boundaries.
    IDENTITY = 4
    #: The boundary was found more than once in the row, or out of order.
    ORDER = 5
    #: The light ends or dips under the edge: shadow border, or the border of the field.
    SHADOW = 6
    #: The edge is much steeper or flatter than the blur makes expect.
    SHAPE = 7
    #: The neighbours on either side lead elsewhere: a depth step lies under the edge.
    STEP = 8
    #: Lit, but no edge was found.
    MISSING = 9
    #: The rays do not meet in front of both devices, or miss each other by too much.
    GEOMETRY = 10
    #: With row patterns: no DMD row is known there.
    ROW = 11


#: Reasons that count as refused, by the name used in reports.
REFUSALS = {r: r.name.lower() for r in Reason if r > Reason.UNLIT}
