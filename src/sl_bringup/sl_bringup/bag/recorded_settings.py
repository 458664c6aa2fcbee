"""Settings in a recording: those with which its live stacks and clouds were made."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from sl_bringup.bag.bags import Bag
from sl_camera.sync.match_events import MatcherSettings
from sl_common.errors import BagError, ConfigError
from sl_common.topics import CAMERA_SETTINGS, MATCHING, SETTINGS, Topic
from sl_reconstruct.decode.settings import Settings

_SettingsT = TypeVar("_SettingsT")


@dataclass(frozen=True)
class RecordedSettings:
    """What a recording says about how it was made.

    Parameters
    ----------
    reconstruction : tuple of Settings
        Different ones in the order in which they came into force; empty where there are none.
    matching : MatcherSettings or None
        The last ones.
    full_scale_dn : int
        Where the camera's pixels end, DN; 0 where nothing says it.
    notes : tuple of str
        What cannot be used, and why.
    """

    reconstruction: tuple[Settings, ...] = ()
    matching: MatcherSettings | None = None
    full_scale_dn: int = 0
    notes: tuple[str, ...] = ()

    def of(self, settings_hash: str) -> Settings | None:
        """Settings with this hash, else the last ones; None where there are none.

        Bags without them begin with the defaults, and with the end of the camera's pixels where
        that is known.
        """
        for settings in self.reconstruction:
            if settings.hash() == settings_hash:
                return settings
        if self.reconstruction:
            return self.reconstruction[-1]
        return Settings(saturation_dn=self.full_scale_dn) if self.full_scale_dn else None

    def differences(self, settings: Settings, matching: MatcherSettings) -> list[str]:
        """Say what is chosen otherwise than the recording has it.

        Parameters
        ----------
        settings : Settings
            Of the reconstruction.
        matching : MatcherSettings
            Of the matching.
        """
        found = []
        if (recorded := self.of("")) is not None:
            found += _differences(settings.to_dict(), recorded.to_dict())
        if self.matching is not None:
            found += _differences(matching.to_dict(), self.matching.to_dict())
        return found


def read_settings(bag: Bag) -> RecordedSettings:
    """Read all settings of a recording; what cannot be used is noted, and the defaults hold."""
    notes: list[str] = []
    reconstruction = _all(bag, SETTINGS, Settings.from_dict, notes)
    matching = _all(bag, MATCHING, MatcherSettings.from_dict, notes)
    scales = [scale for scale in _all(bag, CAMERA_SETTINGS, _full_scale_dn, notes) if scale]
    for what, found in (("matching settings", matching), ("camera full scales", scales)):
        if len(found) > 1:
            notes.append(f"the {what} changed during the recording; the last ones hold for all")
    return RecordedSettings(
        tuple(reconstruction),
        matching[-1] if matching else None,
        scales[-1] if scales else 0,
        tuple(notes),
    )


def _all(
    bag: Bag, topic: Topic, read: Callable[[Mapping[str, Any]], _SettingsT], notes: list[str]
) -> list[_SettingsT]:
    """Different settings of a topic; those repeated, by a split file or a restart, once."""
    found: list[_SettingsT] = []
    if not bag.has(topic):
        return found
    try:
        for recorded in bag.messages(topic, quick=True):
            settings = read(json.loads(recorded.message.data))
            if settings in found:
                found.remove(settings)
            found.append(settings)
    except (BagError, ConfigError, ValueError, TypeError, AttributeError) as exc:
        notes.append(f"{topic.name} in the bag cannot be used, the defaults hold: {exc}")
        return []
    return found


def _full_scale_dn(values: Mapping[str, Any]) -> int:
    scale = values.get("full_scale_dn", 0)
    if not (isinstance(scale, int) and 0 <= scale < 1 << 16):
        raise ConfigError(f"full_scale_dn={scale!r}; expected 0 to 65535")
    return scale


def _differences(used: Mapping[str, Any], recorded: Mapping[str, Any]) -> list[str]:
    return [
        f"{name}={_word(value)} is used, the recording has {_word(recorded[name])}"
        for name, value in used.items()
        if recorded[name] != value
    ]


def _word(value: Any) -> str:
    return "its default" if value is None else f"{value}"
