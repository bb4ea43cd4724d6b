"""Mirror coatings: bare metals, by their complex refractive index, and what they reflect of light that falls obliquely.

Protected and enhanced coatings are another thing: a dielectric layer on top changes both polarisations by its own
interference. They are not modelled; the metal beneath stands for them at best.

References
----------
.. [1] Born and Wolf, "Principles of Optics", 7th edition, 1999, sections 1.5.2 (Fresnel's formulae) and 14.2 (metals).
.. [2] Rakic, "Algorithm for the determination of intrinsic optical constants of metal films: application to aluminum",
   Applied Optics 34, 1995. doi:10.1364/AO.34.004755
.. [3] Johnson and Christy, "Optical constants of the noble metals", Physical Review B 6, 1972.
   doi:10.1103/PhysRevB.6.4370
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.complex128]
Coating = Literal["aluminium", "gold", "silver", "ideal"]  # ideal: reflects everything, at any angle
# Rows: wavelength [nm], n, k; straight between. Evaporated films at room temperature.
_ALUMINIUM = np.array([  # [2]
    (309.96, 0.28003, 3.7081), (326.28, 0.31474, 3.9165), (364.66, 0.39877, 4.3957), (413.28, 0.52135, 5.0008),
    (442.80, 0.60790, 5.3676), (476.87, 0.72780, 5.7781), (516.60, 0.87340, 6.2418), (563.57, 1.0728, 6.7839),
    (619.93, 1.3660, 7.4052), (652.25, 1.5724, 7.7354), (688.81, 1.8301, 8.0601), (729.32, 2.1606, 8.3565),
    (774.91, 2.6154, 8.4914), (794.78, 2.7675, 8.3866), (815.69, 2.7668, 8.2573), (837.74, 2.6945, 8.1878),
    (885.61, 2.2802, 8.1134), (911.66, 1.9739, 8.3058), (939.28, 1.6784, 8.5970), (968.63, 1.4867, 9.0655),
    (999.88, 1.4359, 9.4939), (1033.2, 1.3998, 9.8914), (1127.1, 1.3281, 10.969), (1239.9, 1.3157, 12.245),
    (1377.6, 1.3899, 13.784), (1549.8, 1.5782, 15.656), (1771.2, 1.9205, 17.991), (2066.4, 2.4738, 20.982),
])  # fmt: skip
_GOLD = np.array([  # [3]
    (310.7, 1.53, 1.893), (320.4, 1.54, 1.898), (331.5, 1.48, 1.883), (342.5, 1.48, 1.871), (354.2, 1.50, 1.866),
    (367.9, 1.48, 1.895), (381.5, 1.46, 1.933), (397.4, 1.47, 1.952), (413.3, 1.46, 1.958), (430.5, 1.45, 1.948),
    (450.9, 1.38, 1.914), (471.4, 1.31, 1.849), (495.9, 1.04, 1.833), (520.9, 0.62, 2.081), (548.6, 0.43, 2.455),
    (582.1, 0.29, 2.863), (616.8, 0.21, 3.272), (659.5, 0.14, 3.697), (704.5, 0.13, 4.103), (756.0, 0.14, 4.542),
    (821.1, 0.16, 5.083), (892.0, 0.17, 5.663), (984.0, 0.22, 6.350), (1088.0, 0.27, 7.150), (1216.0, 0.35, 8.145),
    (1393.0, 0.43, 9.519), (1610.0, 0.56, 11.21), (1937.0, 0.92, 13.78),
])  # fmt: skip
_SILVER = np.array([  # [3]
    (310.7, 1.13, 0.616), (320.4, 0.81, 0.392), (331.5, 0.17, 0.829), (342.5, 0.14, 1.142), (354.2, 0.10, 1.419),
    (367.9, 0.07, 1.657), (381.5, 0.05, 1.864), (397.4, 0.05, 2.070), (413.3, 0.05, 2.275), (430.5, 0.04, 2.462),
    (450.9, 0.04, 2.657), (471.4, 0.05, 2.869), (495.9, 0.05, 3.093), (520.9, 0.05, 3.324), (548.6, 0.06, 3.586),
    (582.1, 0.05, 3.858), (616.8, 0.06, 4.152), (659.5, 0.05, 4.483), (704.5, 0.04, 4.838), (756.0, 0.03, 5.242),
    (821.1, 0.04, 5.727), (892.0, 0.04, 6.312), (984.0, 0.04, 6.992), (1088.0, 0.04, 7.795), (1216.0, 0.09, 8.828),
    (1393.0, 0.13, 10.10), (1610.0, 0.15, 11.85), (1937.0, 0.24, 14.08),
])  # fmt: skip
METALS: Mapping[str, Floats] = MappingProxyType({"aluminium": _ALUMINIUM, "gold": _GOLD, "silver": _SILVER})


def reflectance(coating: Coating, wavelength_nm: Floats, incidence_rad: Floats) -> Floats:
    """Give the share of unpolarised light that a coating reflects, (incidence, band): the mean of both polarisations.

    Valid from 311 to 1937 nm, and for films that no light passes (50 nm or more); beyond, the index of the nearest end
    is held.
    """
    if coating == "ideal":
        return np.ones((len(incidence_rad), len(wavelength_nm)))
    across, within = fresnel(refractive_index(coating, wavelength_nm), incidence_rad[:, None])
    mean: Floats = (across + within) / 2
    return mean


def refractive_index(coating: Coating, wavelength_nm: Floats) -> Indices:
    """Give n + ik of a metal, (band,)."""
    nm, n, k = METALS[coating].T
    index: Indices = np.interp(wavelength_nm, nm, n) + 1j * np.interp(wavelength_nm, nm, k)
    return index


def fresnel(index: Indices, incidence_rad: Floats) -> tuple[Floats, Floats]:
    """Give what a surface in air reflects of light polarised across (s) and within (p) the plane of incidence [1]."""
    cosine, square = np.cos(incidence_rad), index**2
    beyond = np.sqrt(square - np.sin(incidence_rad) ** 2)  # index times the cosine behind the surface
    across = np.abs((cosine - beyond) / (cosine + beyond)) ** 2
    within = np.abs((square * cosine - beyond) / (square * cosine + beyond)) ** 2
    return across, within
