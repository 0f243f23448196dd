"""What tests of reports share."""

import sys
from html.parser import HTMLParser

FAILING = (sys.executable, "-c", "raise SystemExit('no OpenGL here')")


class Page(HTMLParser):
    """What a page refers to, its images' descriptions, and its text."""

    def __init__(self, path):
        super().__init__()
        self.links, self.images, self.text = [], [], ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.text = " ".join(self.text.replace("\u00a0", " ").split())

    def handle_starttag(self, tag, attrs):
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]
        if tag == "img":
            self.images.append(dict(attrs))

    def handle_data(self, data):
        self.text += data
