"""Writes the laws of silicones, warp_resphys/laws/*.json, and the tables of
docs/results/silicones.md from tests.

    python scripts/silicone_laws.py FOLDER

FOLDER has the tables of the Soft Robotics Materials Database (Marechal and others, Soft Robotics 8,
2021, doi 10.1089/soro.2019.0115; repository LucMarechal/Soft-Robotics-Materials-Database, Open
Database License 1.0).
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from warp_resphys.core.energies.catalogue import read_law
from warp_resphys.core.energies.isochoric import shear_modulus, stress
from warp_resphys.data.material_tables import read_test
from warp_resphys.io.resuming import package_versions
from warp_resphys.learning.identification.material_tests import (
    BEYOND,
    MeasuredLaw,
    identify_from_tests,
)
from warp_resphys.learning.identification.specimens import MaterialTest
from warp_resphys.settings.data_kinds import TableSettings

ROOT: Final = Path(__file__).parents[1]
PAGE: Final = ROOT / "docs" / "results" / "silicones.md"
TABLE: Final = TableSettings(columns=(None, None, None, "strain", "stress [MPa]"), header_lines=18)
SOURCE: Final = (
    "Uniaxial tension, ASTM D412 die C, 450 mm/min, strain from the crosshead; Soft Robotics "
    "Materials Database, doi 10.1089/soro.2019.0115, Open Database License 1.0"
)
PSI: Final = 6.894757  # kPa
LOW: Final = 0.05  # strain below which the tests are uncertain
SHIPPED: Final = 2.0  # largest strain that the laws of the package are identified from
RANGES: Final = (0.5, 1.0, 1.5, 2.0)  # largest strains by which the intervals are tested
# Of intervals for each doubling of the strain.
GROWTHS: Final = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
LEVEL: Final = 0.9
ASKED: Final = 1.0  # largest strain that the predictions are made from
# File, nominal density [kg/m^3], and 100 % modulus by the data sheet [psi], if it was at hand, of
# the laws by name.
LAWS: Final[dict[str, tuple[str, float, float | None]]] = {
    "ecoflex_00_10": ("Ecoflex 00-10", 1040.0, 8.0),
    "ecoflex_00_30": ("Ecoflex 00-30", 1070.0, 10.0),
    "ecoflex_00_35_fast": ("Ecoflex 00-35 FAST", 1070.0, None),
    "ecoflex_00_50": ("Ecoflex 00-50", 1070.0, 12.0),
    "dragon_skin_10_tensile": ("Dragon Skin 10 MEDIUM", 1070.0, 22.0),
    "dragon_skin_20": ("Dragon Skin 20", 1080.0, 49.0),
    "dragon_skin_30": ("Dragon Skin 30", 1080.0, 86.0),
    "dragon_skin_fx_pro": ("Dragon Skin FX Pro", 1060.0, None),
    "mold_star_16_fast": ("Mold Star 16 FAST", 1180.0, None),
    "mold_star_20t": ("Mold Star 20T", 1080.0, None),
    "rebound_25": ("Rebound 25", 1140.0, None),
    "sortaclear_40": ("SortaClear 40", 1080.0, None),
}


@dataclass(frozen=True)
class Tension:
    """A tensile test of a silicone."""

    name: str
    strain: Any
    stress: Any

    @classmethod
    def read(cls, path: Path) -> "Tension":
        """Reads a table, without the lines before its specimen is under load."""
        read = read_test(path, TABLE)
        return cls(path.stem, read["strain"], read["stress"])

    def within(self, low: float, high: float) -> MaterialTest:
        """Returns the samples between two strains, with an unknown zero of the load cell."""
        rows = (self.strain >= low) & (self.strain <= high)
        return MaterialTest(
            "tension",
            self.strain[rows],
            self.stress[rows],
            zero=0.05 * float(self.stress[rows].max()),
        )

    def law(self, high: float, density: float = 1070.0, **options: Any) -> MeasuredLaw:
        """Returns the law that is identified up to a strain."""
        return identify_from_tests({"tension": self.within(LOW, high)}, density=density, **options)

    def prediction(
        self, law: MeasuredLaw, high: float, growth: float = BEYOND
    ) -> tuple[float, float]:
        """Returns the relative error from a strain to twice that,
        and the share of the stresses in the interval.
        """
        beyond = self.within(math.nextafter(high, math.inf), 2.0 * high)
        value, half = law.interval("tension", beyond.strain, growth)
        held = np.abs(value + law.machines["tension"]["zero"] - beyond.stress) <= half
        return float(np.sqrt(np.square(law.away("tension", beyond)).mean())), float(held.mean())


def main(arguments: Sequence[str]) -> None:
    """Writes the laws and the tables of the page."""
    files = sorted(Path(arguments[0]).glob("*.csv")) if len(arguments) == 1 else []
    if not files:
        raise SystemExit("give the folder with the tables of the Soft Robotics Materials Database.")
    tests = {path.stem: Tension.read(path) for path in files}
    laws = {name: tests[file].law(SHIPPED, density) for name, (file, density, _) in LAWS.items()}
    for name, law in laws.items():
        content: dict[str, Any] = {**law.content()}
        del content["classes"]
        content["versions"] = package_versions()
        content["data"] = {"material": LAWS[name][0], "source": SOURCE, "strains": [LOW, SHIPPED]}
        text = json.dumps(content, indent=1, ensure_ascii=False)
        (ROOT / "warp_resphys" / "laws" / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    for name, rows in {
        "laws": _laws(laws),
        "predicted": _predictions(tests),
        "twice": _dragon_skins(),
    }.items():
        start, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
        text = (
            text[: text.index(start) + len(start)]
            + "\n".join(rows)
            + "\n"
            + text[text.index(end) :]
        )
    PAGE.write_text(text, encoding="utf-8")


def _laws(laws: dict[str, MeasuredLaw]) -> list[str]:
    rows = [
        "| name | $c_{10}$ | $c_{01}$ | $\\mu_3$ | shear modulus at rest | error | stress at 100 "
        "% | by data sheet |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, law in laws.items():
        values = [law.parameters.get(term, 0.0) for term in ("c10", "c01", "ogden_3")]
        cells = [f"{1e-3 * value:.2f}" if value else "" for value in values]
        modulus, error = 1e-3 * shear_modulus(law.parameters), 100.0 * law.errors["tension"]
        sheet = LAWS[name][2]
        (at_100,) = 1e-3 * stress("tension", np.array([1.0]), law.parameters)
        cells += [
            f"{modulus:.1f}",
            f"{error:.1f} %",
            f"{at_100:.0f}",
            "" if sheet is None else f"{PSI * sheet:.0f}",
        ]
        rows.append(f"| `{name}` | {' | '.join(cells)} |")
    return rows


def _predictions(tests: dict[str, Tension]) -> list[str]:
    rows = [
        "| silicone | neo-Hookean, 5 to 100 % | law "
        "| neo-Hookean, 100 to 200 % | law | in the 90 % interval |",
        "|---|---|---|---|---|---|",
    ]
    for name, test in _reaching(tests, ASKED).items():
        law, simple = test.law(ASKED), test.law(ASKED, terms=())
        beyond, held = test.prediction(law, ASKED)
        errors = (
            simple.errors["tension"],
            law.errors["tension"],
            test.prediction(simple, ASKED)[0],
            beyond,
        )
        rows.append(
            f"| {name} | {' | '.join(f'{100.0 * error:.1f} %' for error in errors)} | "
            f"{100.0 * held:.0f} % |"
        )
    # By silicone: of each range, for each of GROWTHS.
    shares, by_growth = [], dict[str, list[list[float]]]()
    for high in RANGES:
        covered = list[float]()
        for name, test in _reaching(tests, high).items():
            law = test.law(high)
            covered.append(test.prediction(law, high)[1])
            by_growth.setdefault(name, []).append(
                [test.prediction(law, high, growth)[1] for growth in GROWTHS]
            )
        shares.append(f"{100.0 * np.mean(covered):.0f} %")
    ends = ", ".join(f"{100.0 * high:.0f} %" for high in RANGES)
    said = (
        f"Of laws that are identified up to {ends}, "
        f"the 90 % intervals hold {', '.join(shares)} of the stresses"
    )
    return [
        *rows,
        "",
        f"{said} up to twice these strains, means over all silicones. {_left_out(by_growth)}",
    ]


def _left_out(by_growth: dict[str, list[list[float]]]) -> str:
    """A sentence on intervals whose growth is chosen without the silicone that they are for."""
    chosen, held = list[float](), list[float]()
    for name, mine in by_growth.items():
        others = np.mean(
            [row for other, rows in by_growth.items() if other != name for row in rows], axis=0
        )
        growth = int(np.argmax(others >= LEVEL))
        chosen.append(100.0 * GROWTHS[growth])
        held += [row[growth] for row in mine]
    least, most = min(chosen), max(chosen)
    of = f"{least:.0f} %" if least == most else f"{least:.0f} to {most:.0f} %"
    return (
        "Chosen on all silicones but the one that is predicted, the least width that holds 90 % "
        f"of the stresses is {of} for each doubling of the strain, and holds "
        f"{100.0 * np.mean(held):.0f} % of those left out."
    )


def _reaching(tests: dict[str, Tension], high: float) -> dict[str, Tension]:
    """Returns the tests that reach twice a strain."""
    return {name: test for name, test in tests.items() if float(test.strain.max()) >= 2.0 * high}


def _dragon_skins() -> list[str]:
    strains = np.array([0.1, 1.0, 2.0])
    rows = ["| law | 10 % | 100 % | 200 % |", "|---|---|---|---|"]
    for name in ("dragon_skin_10", "dragon_skin_10_tensile"):
        values = 1e-3 * stress("tension", strains, read_law(name)["parameters"])
        rows.append(f"| `{name}` | {' | '.join(f'{value:.0f} kPa' for value in values)} |")
    return rows


if __name__ == "__main__":
    main(sys.argv[1:])
