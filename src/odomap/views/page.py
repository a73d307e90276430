"""One self-contained HTML page: no link, no library, no network, and no text that could act.

Everything a page shows from outside (file names, reasons, configuration) passes `text`, which
escapes it. A content security policy allows images inside the page and the one script by its hash:
whatever else came in, nothing would run and nothing would be fetched.
"""

import base64
import hashlib
import html
from collections.abc import Iterable, Sequence
from importlib import resources

__all__ = ["details", "folded", "image", "page", "section", "swatch", "table", "text"]


def text(value: object) -> str:
    """Escape any value for use as text or inside a quoted attribute; control characters go."""
    clean = "".join(c if c.isprintable() or c in "\n\t" else "�" for c in str(value))
    return html.escape(clean, quote=True)


def section(name: str, title: str, body: str, long: bool = False) -> str:
    """Wrap HTML as a section with a heading that can be jumped to."""
    kind = ' class="long"' if long else ""
    return f'<section id="{name}"{kind}>\n<h2>{text(title)}</h2>\n{body}\n</section>'


def table(head: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """Make a table of HTML cells; columns in `numbers` are set to the right."""

    def cells(tag: str, row: Sequence[str]) -> str:
        kinds = [' class="n"' if k in numbers else "" for k in range(len(row))]
        return "".join(f"<{tag}{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, row))

    top = f"<thead><tr>{cells('th', head)}</tr></thead>" if head else ""
    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="scroll"><table>{top}<tbody>\n{body}\n</tbody></table></div>'


def swatch(colour: str | None) -> str:
    """Make a small square of a colour; an empty one of the same size for None."""
    return f'<i class="swatch" style="background:{text(colour or "none")}"></i>'


def details(summary: str, body: str) -> str:
    """Fold text away under a summary, both escaped."""
    return f"<details><summary>{text(summary)}</summary><pre>{text(body)}</pre></details>"


def folded(summary: str, body: str) -> str:
    """Fold HTML away under a summary, which is escaped."""
    return f"<details><summary>{text(summary)}</summary>{body}</details>"


def image(data: bytes, kind: str, alt: str) -> str:
    """Embed a picture; `kind` is png or jpeg."""
    encoded = base64.b64encode(data).decode("ascii")
    return f'<img src="data:image/{kind};base64,{encoded}" alt="{text(alt)}">'


def asset(name: str) -> str:
    """Read a file that lies beside this module."""
    return resources.files("odomap.views").joinpath(name).read_text(encoding="utf-8")


def page(title: str, body: str, with_script: bool) -> str:
    """Put a body into a whole document, with the style and, where wanted, the 3D view's script."""
    script = asset("path3d.js") if with_script else ""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    allowed = f"'sha256-{digest}'" if with_script else "'none'"
    policy = (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src {allowed}; "
        "base-uri 'none'; form-action 'none'"
    )
    tail = f"<script>{script}</script>" if with_script else ""
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{text(title)}</title>
<link rel="icon" href="data:,">
<style>
{asset("report.css")}</style>
</head>
<body>
<main>
{body}
</main>
{tail}
</body>
</html>
"""
