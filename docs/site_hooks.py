"""For MkDocs: links to sources beside the documentation become their text, once it is known that the file is there."""

import re
from pathlib import Path

LINK = re.compile(r"\[([^\]]+)\]\((\.\./[^)#\s]+)[^)]*\)")


def on_page_markdown(markdown, page, **_):
    folder = Path(page.file.abs_src_path).parent

    def text(link):
        if not (folder / link[2]).exists():
            raise ValueError(f"{page.file.src_path}: {link[2]} is not there")
        return link[1]

    return LINK.sub(text, markdown)
