"""Helpers for tests of reports."""

import base64
import hashlib
import sys
from html.parser import HTMLParser

from warp_resphys.experiment.report import make_report
from warp_resphys.io.resuming import StageContext
from warp_resphys.report.page import Canvas, Drawn

FAILING = (sys.executable, "-c", "raise SystemExit('no OpenGL here')")


class Page(HTMLParser):
    """A page: its links, images, scripts and text."""

    def __init__(self, path):
        super().__init__()
        self.links, self.images, self.text, self.scripts, self.data, self.inside = (
            [],
            [],
            "",
            [],
            [],
            None,
        )
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.text = " ".join(self.text.replace("\u00a0", " ").split())

    def handle_starttag(self, tag, attrs):
        self.links += [
            value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")
        ]
        if tag == "script":
            self.inside = self.scripts if dict(attrs).get("type") is None else self.data
            self.inside.append("")
        if tag == "img":
            self.images.append(dict(attrs))

    def handle_endtag(self, tag):
        self.inside = None if tag == "script" else self.inside

    def handle_data(self, data):
        if self.inside is None:
            self.text += data
        else:
            self.inside[-1] += data

    def says(self, *words):
        """Checks that its text has words."""
        assert [word for word in words if word not in self.text] == []

    def lacks(self, *words):
        """Checks that its text does not have words."""
        assert [word for word in words if word in self.text] == []

    def allows_its_scripts_alone(self):
        """Whether the content security policy allows exactly the page's own scripts."""
        digests = [
            base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
            for script in self.scripts
        ]
        policy = self.source.partition("Content-Security-Policy")[2].partition(">")[0]
        allowed = policy.partition("script-src ")[2].partition(";")[0].rstrip('"').split()
        return "default-src 'none'" in policy and allowed == [
            f"'sha256-{digest}'" for digest in digests
        ]


def skip_figures(patch):
    """Keeps the names of figures, by a patch of pytest, in place of drawing them."""

    def figure(canvas, name, _, alt, caption):
        (canvas.folder / f"{name}.png").touch()
        return Drawn(name, caption, alt, "data:,")

    patch.setattr(Canvas, "figure", figure)


def report(folder, settings, make=make_report):
    """Makes the report of a run folder."""
    make(StageContext("report", folder, "", settings))
    return Page(folder / "report.html")
