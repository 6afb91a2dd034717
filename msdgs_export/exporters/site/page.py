"""The page of a site: the viewer's, without what needs the service, and with what search engines and links show."""

import re
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

from msdgs_serve.scene.errors import InvalidInput

PREVIEW = "preview.jpg"
PREVIEW_SIZE = (1200, 630)
"""Width and height in pixels, as links show images."""

POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'"
)
ADDRESS = re.compile(r"""(?P<host>https?://[^\s/?#"'<>\\\ud800-\udfff]+)(?P<path>(/[^?#]*)?)""", re.IGNORECASE)
OF_SERVICE = re.compile(r" *<!-- service -->\n.*?<!-- /service -->\n", re.DOTALL)


@dataclass(frozen=True)
class PageText:
    """What a page says about its scene. `url` is the address of the folder, if it is known."""

    title: str
    description: str
    url: str | None


def folder_url(url: str) -> str:
    """The address of a site's folder, with a slash at its end. Raises `InvalidInput` if it isn't one of the web."""
    match = ADDRESS.fullmatch(url)
    if match is None:
        raise InvalidInput("url", "the address of the folder, such as https://example.org/toys/", url)
    path = match["path"].removesuffix("index.html").rstrip("/") + "/"
    return match["host"] + quote(path, safe="/%~+,;=:@", errors="surrogateescape")


def site_page(viewer_page: str, text: PageText) -> str:
    """The HTML of a site from that of the viewer."""
    head, *_ = OF_SERVICE.findall(viewer_page)
    page = OF_SERVICE.sub("", viewer_page.replace(head, _head(text)))
    for old, new in (
        ('<h1 id="title">msdgs</h1>', f'<h1 id="title">{escape(text.title)}</h1>'),
        ('<progress id="loading"', f'<img id="preview" src="{PREVIEW}" alt="" />\n        <progress id="loading"'),
    ):
        assert page.count(old) == 1, old
        page = page.replace(old, new)
    return page


def _head(text: PageText) -> str:
    lines = [
        f'<meta http-equiv="Content-Security-Policy" content="{escape(POLICY)}" />',
        '<meta name="referrer" content="no-referrer" />',
        f"<title>{escape(text.title)}</title>",
        *(f'<meta {key}="{name}" content="{escape(value)}" />' for key, name, value in _tags(text)),
        '<script src="viewer/site/served.js" defer></script>',
        '<script type="module" src="viewer/site/main.js"></script>',
    ]
    return "".join(f"    {line}\n" for line in lines)


def _tags(text: PageText) -> list[tuple[str, str, str]]:
    """Attribute, name and content of `meta` elements; images of links need absolute addresses."""
    tags = [("name", "description", text.description)]
    if text.url is not None:
        width, height = PREVIEW_SIZE
        tags += [
            ("property", "og:type", "website"),
            ("property", "og:url", text.url),
            ("property", "og:title", text.title),
            ("property", "og:description", text.description),
            ("property", "og:image", text.url + PREVIEW),
            ("property", "og:image:width", str(width)),
            ("property", "og:image:height", str(height)),
            ("name", "twitter:card", "summary_large_image"),
        ]
    return tags


def iframe(text: PageText, folder: str) -> str:
    """The line of HTML that shows a site in another page; `folder` is its address if the text has none."""
    address = escape(text.url or f"{quote(folder, errors='surrogateescape')}/")
    return (
        f'<iframe src="{address}" title="{escape(text.title)}" width="800" height="600" style="border: 0" '
        'allow="fullscreen" loading="lazy"></iframe>'
    )
