"""The commands of CODE V's lens data: which are read, which bend no ray, and which are refused."""

# Aperture, fields, wavelengths and surroundings of the system.
SYSTEM = (
    *("TIT", "DIM", "EPD", "FNO", "NA", "NAO", "WL", "REF", "WTW", "TEM", "PRE", "PUI"),
    *("XAN", "YAN", "XOB", "YOB", "XIM", "YIM", "XRI", "YRI", "WTF", "VUX", "VLX", "VUY", "VLY"),
    "TEL",
)
# Of one surface: the one whose lines they follow, or the one that `S4` names.
SURFACE = (
    *("RDY", "CUY", "THI", "GLA", "RMD", "STO", "SLB", "SPH", "CON", "ASP", "K", "PIM"),
    *("A", "B", "C", "D", "E", "F", "G", "H", "J", "CUF", "SPS", "SCO"),
    *("DIF", "HOR", "HWL", "HCT", "HCO"),
    *("CIR", "REX", "REY", "ELX", "ELY", "ADX", "ADY", "ARO"),
    *("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "XOD", "YOD", "ZOD", "DAR", "BEN", "REV"),
)
# What bends no ray, by what it is about; the results of solves and pick-ups are written anyway.
_WITHOUT_EFFECT = {
    "variables, couplings and limits of an optimization": (
        *("CCY", "CCX", "THC", "GLC", "KC", "AC", "BC", "CC", "DC", "EC", "FC", "GC", "HC", "JC"),
        *("CCF", "XDC", "YDC", "ZDC", "ADC", "BDC", "CDC", "HCC", "SCC", "CUM", "THM", "PIK"),
    ),
    "tolerances": (
        *("TDY", "TDX", "TDR", "TDZ", "TTA", "TTB", "TTC", "TIR", "DLF", "DLT", "DLN", "DLV"),
        *("DLZ", "DLA", "DLB", "DLC", "DLX", "DLY", "DLK", "DLR", "DLS", "BTI", "BTX", "BTY"),
        *("TRX", "TRY", "CYD", "CYN", "CYT", "TOL", "COM"),
    ),
    "polarization": ("POL",),
    "settings of the program": ("CA", "CWL", "CLS", "DER", "DOR", "IC", "IFO", "ACO"),
    "": ("INI", "UID", "VIE", "WID"),
}
GROUP_OF = {key: group for group, keys in _WITHOUT_EFFECT.items() for key in keys}
# What bends rays and is not held: three letters → the name that optics gives it.
REFUSED = {
    "CYL": "a cylinder",
    "XTO": "a toroid",
    "YTO": "a toroid",
    "AAS": "an anamorphic asphere",
    "CUX": "a second radius, across x",
    "RDX": "a second radius, across x",
    "SPL": "a spline surface",
    "UDS": "a surface of the user's own program",
    "ZRN": "a Zernike surface",
    "HOE": "a hologram",
    "GRT": "a diffraction grating",
    "GRO": "a diffraction order",
    "GRS": "the spacing of a diffraction grating",
    "GRX": "the direction of a diffraction grating",
    "GRY": "the direction of a diffraction grating",
    "FRN": "a Fresnel lens",
    "LMO": "a lens module",
    "MFL": "the focal length of a lens module",
    "NSS": "a group of non-sequential surfaces",
    "ARR": "an array of surfaces",
    "INT": "an interferogram file on a surface",
    "INS": "a lens inserted from another file",
    "GRN": "a gradient index",
    "GLB": "axes relative to another surface (GLB)",
    "RET": "a return to the axes of another surface (RET)",
    "CIG": "an aperture with its own place",
    "REG": "an aperture with its own place",
    "ELG": "an aperture with its own place",
    "POY": "a polygon as aperture",
    "BIR": "a birefringent medium",
    "APD": "apodization of the pupil",
    "PUX": "the width of a Gaussian beam",
    "PUY": "the width of a Gaussian beam",
    "DST": "a surface with a distribution",
}
# Programs in CODE V's own language begin with these, or with a variable (^x).
MACRO = ("NUM", "STR", "FOR", "IF", "WHI", "EVA", "WRI", "BUF", "LCL", "GBL", "FCT", "RFD", "IN")
