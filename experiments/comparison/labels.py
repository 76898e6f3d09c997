"""Names of settings and metrics in words, with units, for axes and headings."""

_WORDS = {"psnr": "PSNR", "ssim": "SSIM", "rms": "RMS", "efl": "EFL", "mtf": "MTF"}
_UNITS = {
    **{"db": "dB", "um": "µm", "mm": "mm", "nm": "nm", "s": "s", "mb": "MB", "deg": "°"},
    **{"grey_levels": "grey levels", "pixels": "pixels"},
}
# By the last part of a setting's name; lens files and configurations share these units.
_SETTINGS = {
    **dict.fromkeys(
        (
            *("radius", "thickness", "semi_diameter", "stop_semi_diameter", "distance"),
            *("diameter", "pixel_pitch", "decenter_x", "decenter_y", "shift_z", "depths"),
        ),
        "mm",
    ),
    **dict.fromkeys(("curvature", "curvature_x", "curvature_y"), "1/mm"),
    **dict.fromkeys(("tilt_x", "tilt_y", "tilt_z"), "°"),
    **dict.fromkeys(("wavelength", "wavelengths"), "nm"),
    "light": "electrons in white",
}


def metric_label(name: str) -> str:
    """Return a metric in words: `test/psnr_db/worst` is `test PSNR, worst (dB)`."""
    unit = ""
    parts = []
    for part in name.split("/"):
        for suffix, symbol in _UNITS.items():
            if part.endswith(f"_{suffix}"):
                part, unit = part.removesuffix(f"_{suffix}"), f" ({symbol})"
                break
        parts.append(" ".join(_WORDS.get(word, word) for word in part.split("_")))
    if parts[0] == "test" and len(parts) > 1:
        parts[:2] = [f"test {parts[1]}"]
    return ", ".join(parts) + unit


def setting_label(name: str) -> str:
    """Return a setting in words: `lens.surfaces.1.radius` is `radius of surface 1 (mm)`."""
    parts = name.split(".")
    last = parts[-1]
    unit = f" ({_SETTINGS[last]})" if last in _SETTINGS else ""
    if len(parts) > 2 and parts[-3] == "surfaces":
        return f"{last.replace('_', ' ')} of surface {parts[-2]}{unit}"
    if parts[-2:] == ["sensor", "distance"]:
        return f"sensor distance{unit}"
    return f"{name}{unit}"
