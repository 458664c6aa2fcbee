"""The sequences against the definition of the Gray code and the paper's counts."""

import numpy as np
import pytest

from sl_common.errors import SequenceError
from sl_projector.sequence.pattern_sequence import Pattern, PatternSequence, gray_bits, named


def edges(line: np.ndarray) -> list[int]:
    """Column boundaries k where mirror k - 1 and mirror k differ."""
    return [int(k) for k in np.flatnonzero(np.diff(line.astype(int))) + 1]


def test_paper_has_the_eleven_patterns_of_section_4():
    sequence = named("paper")
    assert len(sequence) == 11
    assert [p.bit for p in sequence.patterns] == [0, 1, 2, 3, 4, 5, 6, 7, 7, 7, 7]
    assert [p.shift_px for p in sequence.patterns] == [0] * 8 + [0, 1, 2, 3][1:]


def test_gray_code_gives_256_divisions_each_with_its_own_code_and_one_bit_per_step():
    lines = np.array([p.profile(1024) for p in named("paper").patterns[:8]])
    divisions = lines[:, ::4]
    np.testing.assert_array_equal(divisions, lines[:, 3::4])
    assert len({tuple(column) for column in divisions.T}) == 256
    np.testing.assert_array_equal(np.abs(np.diff(divisions.astype(int), axis=1)).sum(axis=0), 1)


def test_coarsest_bit_comes_first_and_splits_the_dmd_in_half():
    assert edges(named("paper").patterns[0].profile(1024)) == [512]


def test_i8_has_128_fringes_and_the_shifted_ones_move_by_one_column():
    fine = [edges(p.profile(1024)) for p in named("paper").patterns[7:]]
    assert fine[0] == list(range(4, 1024, 8))  # 128 edges of stripes 8 columns wide
    for shift, moved in enumerate(fine):
        assert moved[:5] == [4 + shift + 8 * j for j in range(5)]


def test_precise_makes_every_inner_boundary_an_edge_of_a_pair():
    sequence = named("precise")
    fine = sequence.patterns[9:]
    found = sorted(k for p in fine[::2] for k in edges(p.profile(1024)))
    assert found == list(range(1, 1024))
    for pattern, inverse in zip(fine[::2], fine[1::2], strict=True):
        assert np.all(pattern.profile(1024) ^ inverse.profile(1024))


def test_half_period_tells_where_a_pattern_rises_and_falls():
    for pattern in named("precise-rows").patterns:
        if pattern.kind != "gray":
            continue
        size, d = (1024, 768)[pattern.axis == "row"], pattern.half_period_px
        line = pattern.profile(size).astype(int) ^ pattern.inverted
        step = np.diff(line)
        rising, falling = np.flatnonzero(step > 0) + 1, np.flatnonzero(step < 0) + 1
        assert np.all((rising - pattern.shift_px - d) % (4 * d) == 0)
        assert np.all((falling - pattern.shift_px - 3 * d) % (4 * d) == 0)


@pytest.mark.parametrize("size", [(1920, 1080), (2560, 1600), (1024, 768), (64, 32)])
def test_any_dmd_size_gets_a_code_without_repeats(size):
    for axis, side in zip(("column", "row"), size, strict=True):
        patterns = [
            p for p in named("paper-rows", size).patterns if p.axis == axis and not p.shift_px
        ]
        codes = np.array([p.profile(side) for p in patterns])[:, ::4]
        assert len({tuple(c) for c in codes.T}) == -(-side // 4)


def test_frames_are_full_size_and_only_vary_along_their_axis():
    sequence = named("precise-rows", (64, 48))
    for index, pattern in enumerate(sequence.patterns):
        frame = sequence.frame(index)
        assert frame.shape == (48, 64)
        assert set(np.unique(frame)) <= {0, 255}
        across = (
            frame.max(axis=0) == frame.min(axis=0)
            if pattern.axis == "column"
            else (frame.max(axis=1) == frame.min(axis=1))
        )
        assert across.all()
    assert sequence.frame(0).min() == 255
    assert sequence.frame(1).max() == 0


def test_inverse_of_inverse_is_itself():
    pattern = Pattern("gray", "row", 3, 8, 4, 2)
    assert pattern.inverse().inverse() == pattern
    np.testing.assert_array_equal(pattern.inverse().profile(768), ~pattern.profile(768))


@pytest.mark.parametrize(("size", "division", "bits"), [(1024, 4, 8), (1024, 1, 10), (768, 1, 10)])
def test_gray_bits(size, division, bits):
    assert gray_bits(size, division) == bits


@pytest.mark.parametrize(
    "make",
    [
        lambda: Pattern("sine"),  # type: ignore[arg-type]
        lambda: Pattern("gray", "diagonal"),  # type: ignore[arg-type]
        lambda: Pattern("gray", bit=8, bits=8),
        lambda: Pattern("gray", bits=8, division_px=0),
        lambda: Pattern("gray", bit=7, bits=8, division_px=4, shift_px=16),
        lambda: PatternSequence("empty", (1024, 768), ()),
        lambda: PatternSequence("tiny", (2, 768), (Pattern("white"),)),
        lambda: named("papre"),
    ],
)
def test_nonsense_is_refused_with_what_was_expected(make):
    with pytest.raises(SequenceError, match="expected"):
        make()
