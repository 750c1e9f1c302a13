"""MkDocs' hook: pages made when the site is built (mkdocs.yml). README, changelog and examples lie outside docs/."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
OUTSIDE = {"index.md": "README.md"} | {f"{n.lower()}.md": f"{n}.md" for n in ("CHANGELOG", "CONTRIBUTING", "SECURITY")}
MADE = {*OUTSIDE, "examples.md", "commands.md"}
COMMAND_LINE = [sys.executable, "-m", "typer", "posekit.cli.app", "utils", "docs", "--name", "posekit"]


def on_config(config: Any) -> Any:
    """Fill in the list of decisions; leave out pages that are not there, other than the generated ones."""
    decisions = sorted(f"decisions/{file.name}" for file in (ROOT / "docs/decisions").glob("*.md"))

    def kept(entry: dict[str, Any]) -> dict[str, Any] | None:
        [(title, target)] = entry.items()
        if title == "Decisions":
            return {title: decisions}
        if isinstance(target, list):
            return {title: [each for each in map(kept, target) if each]}
        return entry if target in MADE or (ROOT / "docs" / target).exists() else None

    config.nav = [each for each in map(kept, config.nav) if each]
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    command_line = subprocess.run(COMMAND_LINE, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    examples = sorted((ROOT / "examples").glob("*.py"))
    programs = [f"\n## {file.stem}\n```python\n{file.read_text(encoding='utf-8')}```\n" for file in examples]
    pages = {
        **{page: (ROOT / name).read_text(encoding="utf-8") for page, name in OUTSIDE.items()},
        "examples.md": "# Examples\nShort programs of `examples/`; the tests run them.\n" + "".join(programs),
        "commands.md": re.sub(r"^\*\*Commands\*\*:\n\n(\* .*\n)+", "", command_line, flags=re.MULTILINE),
    }
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links as files have them, which hold in the repository, become links between pages."""
    if page.file.src_uri in OUTSIDE:
        markdown = markdown.replace("](docs/decisions)", "](decisions/0001-set-up-checks-and-command-line.md)")
        markdown = markdown.replace("](docs/", "](").replace("[Apache-2.0](LICENSE)", "Apache-2.0")
        markdown = markdown.replace("<details>", '<details markdown="1">')
        for target, name in OUTSIDE.items():
            markdown = markdown.replace(f"]({name})", f"]({target})")
    markdown = re.sub(r"\]\((?:\.\./)?examples/(\w+)\.py\)", r"](examples.md#\1)", markdown)
    return re.sub(r"\]\((?:\.\./)?examples(?:/[\w.]+)?\)", "](examples.md)", markdown)
