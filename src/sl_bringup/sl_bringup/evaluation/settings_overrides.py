"""``name=value``: settings of reconstruction and matching as a user gives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import yaml

from sl_camera.sync.match_events import MatcherSettings
from sl_common.errors import ConfigError
from sl_reconstruct.decode.settings import Settings

OF_SETTINGS = {f.name for f in fields(Settings)}
OF_MATCHING = {f.name for f in fields(MatcherSettings)}


def parse_choices(
    assignments: Sequence[str],
    base: Settings | None = None,
    matching: MatcherSettings | None = None,
) -> tuple[Settings, MatcherSettings]:
    """Read ``name=value`` assignments: settings of the reconstruction and of the matching.

    Parameters
    ----------
    assignments : sequence of str
        What is changed; the last one counts.
    base : Settings, optional
        What is changed of the reconstruction; the defaults when left out.
    matching : MatcherSettings, optional
        What is changed of the matching; the defaults when left out.

    Raises
    ------
    ConfigError
        When a name is unknown or a value cannot be used.
    """
    values: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or name not in OF_SETTINGS | OF_MATCHING:
            raise ConfigError(
                f"{assignment!r}; expected name=value with one of "
                f"{', '.join(sorted(OF_SETTINGS))} (reconstruction), "
                f"{', '.join(sorted(OF_MATCHING))} (matching)"
            )
        values[name] = _value(text)
    try:
        return _made(values, base or Settings(), matching or MatcherSettings())
    except (TypeError, ConfigError) as exc:
        raise ConfigError(f"{' '.join(assignments)}: {exc}") from None


def _made(
    values: Mapping[str, Any], base: Settings, matching: MatcherSettings
) -> tuple[Settings, MatcherSettings]:
    of_settings = {k: v for k, v in values.items() if k in OF_SETTINGS}
    of_matching = {k: v for k, v in values.items() if k in OF_MATCHING}
    return (
        Settings.from_dict({**base.to_dict(), **of_settings}),
        MatcherSettings.from_dict({**matching.to_dict(), **of_matching}),
    )


def _value(text: str) -> Any:
    """A number, true, false, null or a word."""
    try:
        value = yaml.safe_load(text)
        return float(value) if isinstance(value, str) else value  # YAML 1.1 has no 1e1
    except (ValueError, yaml.YAMLError):
        return text
