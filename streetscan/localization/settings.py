"""Localizers by name from plain values."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

from streetscan.errors import BadInput
from streetscan.localization.baselines.crossmodal import CrossmodalLocalizer
from streetscan.localization.baselines.kiss_matcher import KissMatcherLocalizer
from streetscan.localization.baselines.registration import GicpLocalizer, NdtLocalizer
from streetscan.localization.drive import DriveSettings, Localizer
from streetscan.localization.localizer import LocalizerSettings, VotingLocalizer
from streetscan.localization.reference import Reference

METHODS = ("voting", "crossmodal", "kiss_matcher", "gicp", "ndt")


def make_localizer(method: str, reference: Reference, settings: Mapping[str, Any]) -> Localizer:
    """A localizer on a map.

    Args:
        method: one of METHODS.
        reference: the map.
        settings: keys of LocalizerSettings, sections as mappings; the reference methods take its `window` alone.
    Raises:
        BadInput: another method, or an unknown key.
    """
    s = build(LocalizerSettings, settings, "localize_frames")
    if method == "voting":
        return VotingLocalizer(reference, s)
    if method == "crossmodal":
        return CrossmodalLocalizer(reference, s.window)
    makers = {"kiss_matcher": KissMatcherLocalizer, "gicp": GicpLocalizer, "ndt": NdtLocalizer}
    if method not in makers:
        raise BadInput("localizers.method", f"'{method}'", f"choose one of {', '.join(METHODS)}")
    return makers[method](reference)


def make_drive_settings(values: Mapping[str, Any]) -> DriveSettings:
    """DriveSettings from plain values; BadInput for an unknown key."""
    return build(DriveSettings, values, "localize_frames")


def build(kind: type, values: Mapping[str, Any], where: str) -> Any:
    """A settings class from plain values, nested sections being mappings. BadInput naming the key when there is no such one."""
    hints, known = get_type_hints(kind), {f.name for f in fields(kind)}
    arguments = {}
    for name, value in values.items():
        if name not in known:
            raise BadInput(f"{where}.{name}", "no such key", f"use one of {', '.join(sorted(known))}")
        nested = is_dataclass(hints[name]) and isinstance(value, Mapping)
        arguments[name] = build(hints[name], value, f"{where}.{name}") if nested else value
    return kind(**arguments)
