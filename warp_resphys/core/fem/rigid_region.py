"""Nearly rigid regions of a mesh."""

from ...io.settings import Positive, Settings, setting


class Rigid(Settings):
    """A nearly rigid region of a mesh, such as an end cap, a base plate or an insert."""

    density: Positive = setting(1200.0, unit="kg/m^3")
    stiffness: Positive = setting(
        1.0e9, "kappa of the energy kappa V |F - R(F)|^2, which penalises deformation", "Pa"
    )
