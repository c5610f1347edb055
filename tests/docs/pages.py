"""The pages of `docs/`, and what in them can be tried."""

import re
from dataclasses import dataclass
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
_FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>[^\n`]*)\n(?P<text>.*?)^(?P=indent)```", re.M | re.S
)
_UNTIL_CTRL_C = 'title="until Ctrl-C"'
_SERVED_S = 8
"""How long a command that goes on is left alone: it has begun to serve within one or two."""
_INLINE = re.compile(r"(?<!`)`(alice-survey [^`]+)`(?!`)")


@dataclass(frozen=True, kw_only=True)
class Fence:
    """A block of code in a page."""

    language: str
    text: str
    line: int
    """At which its text begins, from 1."""
    until_ctrl_c: bool = False
    """Its command goes on until it is interrupted."""

    @property
    def script(self) -> str:
        """What a shell runs of it; a command that goes on is interrupted after some seconds."""
        if not self.until_ctrl_c:
            return self.text
        return (
            f"timeout --preserve-status --signal=INT {_SERVED_S} {self.text.rstrip()} "
            "|| [ $? -eq 130 ]\n"
        )


def pages() -> list[Path]:
    """All of them, in the order of their names."""
    return sorted(DOCS.rglob("*.md"))


def name_of(page: Path) -> str:
    """A page's path within `docs/`."""
    return str(page.relative_to(DOCS))


def fences(page: Path) -> list[Fence]:
    """The blocks of code of a page; what is indented with its list loses that."""
    content = page.read_text(encoding="utf-8")
    return [
        Fence(
            language=found["language"].split(" ")[0],
            text=re.sub(f"^{found['indent']}", "", found["text"], flags=re.M),
            line=content.count("\n", 0, found.start("text")) + 1,
            until_ctrl_c=_UNTIL_CTRL_C in found["language"],
        )
        for found in _FENCE.finditer(content)
    ]


def script_of(page: Path) -> str:
    """The commands of a page as one script, which says where it is."""
    parts = [
        f"echo '### {name_of(page)} line {fence.line}'\n{fence.script}"
        for fence in fences(page)
        if fence.language == "bash"
    ]
    return "\n".join(parts)


def written(page: Path, name: str) -> str:
    """A file that a page writes."""
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^cat > {re.escape(name)} <<'END'\n(.*?)^END$", text, re.M | re.S)[0]


def without_fences(content: str) -> str:
    """A text without its blocks of code."""
    return _FENCE.sub("", content)


def mentioned(content: str) -> list[str]:
    """Commands of ours that a text mentions, in blocks of bash or within a line."""
    blocks = [found["text"] for found in _FENCE.finditer(content)]
    joined = "\n".join(blocks).replace("\\\n", " ")
    inline = [" ".join(text.split()) for text in _INLINE.findall(without_fences(content))]
    return re.findall(r"(?:^|&&|;) *(alice-survey [^\n#|;&>]*)", "\n".join([joined, *inline]), re.M)
