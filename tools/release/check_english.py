"""Find names and sentences that are not plain technical English, and compare with agreed limits.

    python tools/release/check_english.py                 # counts per kind of text and folder
    python tools/release/check_english.py --list gap      # findings in paths that contain "gap"

Kinds of findings:

name      a function or class whose whole name is one adjective, participle, adverb or pronoun
phrase    an idiom of `IDIOMS`, each with the term to use
long      a sentence of a page with more than `MAX_SENTENCE_WORDS` words
history   a commit hash, or how a figure came about, on a page: that belongs to the commit message

Pages are README.md, CHANGELOG.md, CONTRIBUTING.md and the Markdown files of docs, models and tools.
Messages are string constants of at least `MIN_MESSAGE_WORDS` words that are no docstrings: error
messages, help texts, reports; templates count as well. english_allowed.tsv lists correct uses of a
phrase and how many names and docstring phrases each folder may hold. The exit status is 1 where a
limit is exceeded.
"""

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
ALLOWED = Path(__file__).with_name("english_allowed.tsv")
GENERATED_FOLDERS = ("docs/_build", "docs/reference")  # by tools/docs, from texts that are checked
MAX_SENTENCE_WORDS = 32
MIN_MESSAGE_WORDS = 4

IDIOMS = {
    r"(?:is|are|was|were) lacking|lacks?|lacking": "is missing; residual",
    r"told|tells? (?:most|apart|which|whether|how|us)": "identifiable, determined; shows",
    r"what(?:ever)? (?:it|they|one|is|was|are) (?:\w+ ){0,2}(?:lacks?|lacking|told|wanted)": "name it",
    r"asked for": "requested",
    r"(?:of )?one's own|of (?:its|their) own": "custom, separate",
    r"(?:is|are|was) said|says? so": "is stated, reports",
    r"taken back": "rejected, reset",
    r"comes? back": "returns",
    r"beside": "together with, in addition to",
    r"in kind|at a glance|for a while|a while": "state the property or the duration",
    r"makes? up for": "compensates",
    r"rubbing|rubs": "friction",
    r"wanted": "reference, requested",
    r"nothing of": "none of",
    r"rather (?:not )?there": "probably present",
    r"worth (?:naming|telling|its)": "significant",
    r"the numbers? of (?:the|a) (?:machine|model|guess|law|effect)": "parameters",
    r"a guess": "hypothesis, candidate model",
    r"free runs?": "open-loop prediction",
    r"unknown inputs?": "residual inputs",
    r"by far": "state the ratio",
}  # fmt: skip
"""Idiom as a regular expression -> the term to use instead."""

LONE_WORDS = frozenset(
    """able absent ahead alike alive allowed alone along apart around aside asked bad begun behind
    beside best better between beyond big blamed blind both brief clean clipped controlled copied
    covered crossed damped dead done down drawn driven early empty ended enough entered even ever
    every everywhere expected far fast fastest few fewest felt finished first fitted five flat
    found free fresh full further given gone good grown half has have heard held here high hold
    holds idle inside joined judged just kept known lacking last late latest lean learned least
    left less like likely little loaded long loose lost loud low made many masked mended merged
    missing mistaken more most moved moving much named near nearest needed never new newest next
    none nothing off old once one only opened other others ours out outer outside over own
    past placed plain pressed quick ranked rare rated rather reached ready really refined refused
    released renamed replaced rest returned rough same seen sent several shaken shaped shown side
    slow small smallest smoothed soft some soon spoken spread stacked standing started steady steep
    still stopped straight strange strong such taken telling tells that their then there these
    they thick thin thing things this those tight together told too touched toward tracked tried
    true truncated turned twice under undone unknown until up used usual varied very wanted warm
    weak well what when where which while whole whose why wide widened with within without worse
    worst worth wrong yet young""".split()
)
"""Words that say nothing as the whole name of a function or class."""
SUFFIXES = ("ed", "ly", "est")
"""Endings of participles, adverbs and superlatives; nouns and verbs of `NOUNS` end alike."""
NOUNS = frozenset("apply assembly bed digest family feed need reply request rest seed speed supply test".split())

HISTORY = re.compile(
    r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7}\b|was tried|ways? tried|slow host"
    r"|before the change|another program",
    re.IGNORECASE,
)
_PHRASE = re.compile("|".join(rf"(?P<i{k}>\b(?:{p})\b)" for k, p in enumerate(IDIOMS)), re.I)
_LOWER_PHRASE = re.compile("|".join(rf"\b(?:{p})\b" for p in IDIOMS))  # half the time of `_PHRASE`
_DEFINITION = re.compile(r"\s*(?:def|class) (\w+)")
_CODE = re.compile(r"`[^`]*`")
_TEMPLATE_CODE = re.compile(r"\{%.*?%\}|\{\{.*?\}\}|\{#.*?#\}", re.S)
_SENTENCE_END = re.compile(r"(?<=[.!?:;])[*\"]*\s+(?=[A-Z`\[*a-z0-9(+-])")
"""A list after a colon or semicolon counts as a sentence."""


class Finding(NamedTuple):
    """One place that is not plain English.

    Attributes:
        path: of the file, from the repository's root.
        line: counted from 1.
        kind: "name", "phrase", "long" or "history".
        where: "page", "message", "docstring" or "code".
        text: the passage.
        advice: what to write instead, empty where the kind says it.
    """

    path: str
    line: int
    kind: str
    where: str
    text: str
    advice: str = ""


def is_lone_word(name: str) -> bool:
    """Return whether a name is a single adjective, participle, adverb or pronoun."""
    word = name.strip("_").lower()
    if "_" in word or not name.strip("_").islower():
        return False
    return word in LONE_WORDS or (word.endswith(SUFFIXES) and word not in NOUNS)


def check_text(path: str, line: int, where: str, text: str) -> Iterator[Finding]:
    """Find idioms in a text, which starts at a line of a file."""
    for match in _PHRASE.finditer(text):
        advice = list(IDIOMS.values())[int((match.lastgroup or "i0")[1:])]
        begin, end = max(0, match.start() - 40), match.end() + 40
        passage = " ".join(text[begin:end].split())
        yield Finding(path, line + text.count("\n", 0, match.start()), "phrase", where, passage, advice)


def check_page(path: str, text: str) -> Iterator[Finding]:
    """Find idioms, long sentences and history in a Markdown page, outside code."""
    fenced, paragraph, first = False, "", 0
    for number, line in enumerate([*text.splitlines(), ""], 1):
        if line.startswith("```"):
            fenced = not fenced
            continue
        if fenced:
            continue
        plain = _CODE.sub("`x`", line)
        yield from check_text(path, number, "page", plain)
        if HISTORY.search(plain):
            yield Finding(path, number, "history", "page", line.strip())
        if plain.strip() and not plain.startswith(("|", "#", "-", "!")):
            first = first if paragraph else number
            paragraph += f" {plain}"
            continue
        for sentence in _SENTENCE_END.split(paragraph):
            if len(sentence.split()) > MAX_SENTENCE_WORDS:
                yield Finding(path, first, "long", "page", sentence.strip())
        paragraph = ""


def check_module(path: str, source: str) -> Iterator[Finding]:
    """Find unclear names, and idioms in docstrings, comments and messages of a module."""
    for number, line in enumerate(source.splitlines(), 1):
        if (match := _DEFINITION.match(line)) and is_lone_word(match[1]):
            yield Finding(path, number, "name", "code", match[1])
    if not _LOWER_PHRASE.search(source.lower()):
        return
    nodes = list(ast.walk(ast.parse(source)))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            is_docstring = id(node) in docstrings
            if is_docstring or len(node.value.split()) >= MIN_MESSAGE_WORDS:
                where = "docstring" if is_docstring else "message"
                yield from check_text(path, node.lineno, where, node.value)
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield from check_text(path, token.start[0], "docstring", token.string)


def list_files(root: Path) -> list[Path]:
    """List the pages, modules and templates that are checked."""
    pages = [root / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
    for folder in ("docs", "models", "tools"):
        pages += sorted((root / folder).rglob("*.md"))
    generated = [root / folder for folder in GENERATED_FOLDERS]
    pages = [page for page in pages if not any(page.is_relative_to(folder) for folder in generated)]
    package = root / "hydrotele"
    return [
        *filter(Path.is_file, pages),
        *sorted(package.rglob("*.py")),
        *sorted(package.rglob("*.j2")),
    ]


def find_all(root: Path = ROOT) -> list[Finding]:
    """Find everything that is not plain English in a checkout."""
    found: list[Finding] = []
    for file in list_files(root):
        path, text = file.relative_to(root).as_posix(), file.read_text(encoding="utf-8")
        if file.suffix == ".py":
            found += check_module(path, text)
        elif file.suffix == ".md":
            found += check_page(path, text)
        else:
            plain = _TEMPLATE_CODE.sub(lambda code: "\n" * code[0].count("\n"), text)
            found += check_text(path, 1, "message", plain)
    return found


class Limits(NamedTuple):
    """What english_allowed.tsv says.

    Attributes:
        passages: (path, passage) of correct uses.
        most: (folder or "*", kind, where) -> how many findings it may hold.
    """

    passages: frozenset[tuple[str, str]]
    most: dict[tuple[str, str, str], int]


def read_limits(path: Path = ALLOWED) -> Limits:
    """Read the allowed passages and the limits per folder."""
    passages, most = set(), {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line or line.startswith("#"):
            continue
        kind, *rest = line.split("\t")
        if kind == "passage":
            passages.add((rest[0], rest[1]))
        else:
            folder, what, where, count = rest
            most[folder, what, where] = int(count)
    return Limits(frozenset(passages), most)


def folder_of(path: str) -> str:
    """Return the folder that a file counts for: `hydrotele/gap`, `docs`, or the file itself."""
    parts = path.split("/")
    return "/".join(parts[: 2 if parts[0] == "hydrotele" and len(parts) > 2 else 1])


def select_violations(found: list[Finding], limits: Limits) -> list[Finding]:
    """Return the findings of each folder, kind and place that exceed its limit, without allowed ones."""
    open_ones: dict[tuple[str, str, str], list[Finding]] = {}
    for each in found:
        if any(each.path == path and text in each.text for path, text in limits.passages):
            continue
        open_ones.setdefault((folder_of(each.path), each.kind, each.where), []).append(each)
    return [each for key, group in sorted(open_ones.items()) if len(group) > limits.most.get(key, 0) for each in group]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=ROOT, help="checkout to read")
    parser.add_argument("--list", metavar="TEXT", help="print findings in paths that contain TEXT")
    options = parser.parse_args()
    found = find_all(options.root)
    if options.list is not None:
        for each in found:
            if options.list in each.path:
                advice = f" ({each.advice})" if each.advice else ""
                print(f"{each.path}:{each.line}: {each.kind} in {each.where}: {each.text}{advice}")
    kinds = ("name", "phrase", "long", "history")
    counts = Counter((folder_of(each.path), each.kind) for each in found)
    print(f"{'folder':28}" + "".join(f"{kind:>9}" for kind in kinds))
    for folder in sorted({folder for folder, _ in counts}):
        print(f"{folder:28}" + "".join(f"{counts[folder, kind]:9}" for kind in kinds))
    excess = select_violations(found, read_limits())
    for each in excess:
        print(f"{each.path}:{each.line}: {each.kind} in {each.where}: {each.text}", file=sys.stderr)
    return 1 if excess else 0


if __name__ == "__main__":
    sys.exit(main())
