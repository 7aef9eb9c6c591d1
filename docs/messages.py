"""The page of all warnings and errors, from the code that gives them.

Sphinx calls `write_page` before it reads the pages.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

from remedies import ABOUT, REMEDIES

ROOT = Path(__file__).parents[1] / "lpvlearn"

GAP = "…"  # what a message fills in

# Which argument of a call is the text that the user sees.
_FUNNELS = {"warn": 0, "Told": 0, "once": 1}

# Texts that were raised elsewhere and are handed on: they stand on the page once.
RELAYS = {
    "str(error)",
    "message",
    "first.text",
    "stop_as",
    "message if len(kappa) == 1 else f'{message} (At {place}.)'",
    "f'{path.name}: {error}'",
    "f'{value!r} ({error})'",
    "f'{place_of(k, kappa)}: {error}{skip}'",
    "f'{_NOT_OURS}{Path(path).name!r}: {error}'",
}

# Classes that the user does not see by their own names.
_SPOKEN = {
    "type(error)": "ValueError",
    "_Told": "ValueError",
    "_Unknown": "UserWarning",
}

_SECTIONS = {
    "Tables and column roles": ("data",),
    "Local models": ("subspace",),
    "Structures": ("structures",),
    "Restructuring": ("restructuring", "minimax"),
    "LPV models and interpolation": ("lpv",),
    "The pipeline": ("pipeline",),
    "Files": ("pipeline/model_files", "pipeline/running/memory.py"),
    "State-space models": ("models", "systems"),
    "Scores and reports": ("metrics",),
    "Pictures": ("inspection",),
    "Built-in systems": ("datasets", "paper"),
    "The command": ("command", "__main__.py"),
    "Everywhere": ("validation.py", "exceptions.py"),
}

_HEAD = """\
.. _messages:

A warning says ...
==================

Every warning and every error of the library, by its text, with what it means where the
text does not say so. This page is made from the code, so none is missing. Search it
(Ctrl-F) for a few words of your message that are no names and no numbers of yours:
those stand as … here, and of words between ⟨ and ⟩ the message has some, or none.

Each message names what is wrong, the rule, and what was got. What a table should look
like is told in :ref:`guide_data`; the words are explained in the :ref:`glossary`.

"""


class Message(NamedTuple):
    """A text, what it is raised or given as, and the file that does."""

    text: str
    kind: str
    path: str

    @property
    def is_warning(self) -> bool:
        return self.kind.endswith("Warning")


class _Module:
    """A file of the library: its messages, and what their texts are made of."""

    def __init__(self, path: Path, tree: ast.Module, known: dict[str, ast.AST]) -> None:
        self.path, self._tree = path.relative_to(ROOT).as_posix(), tree
        self._known = known | _definitions(tree)
        self._functions = [
            node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)
        ]

    def messages(self) -> Iterator[tuple[ast.expr, list[str], str]]:
        """Expressions that are told, their texts, and what they are told as."""
        for node in ast.walk(self._tree):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                kind = ast.unparse(node.exc.func)
                if node.exc.args and kind != "SystemExit":
                    told = node.exc.args[0]
                    yield told, self._texts(told), kind
            elif isinstance(node, ast.Call):
                name = getattr(node.func, "id", getattr(node.func, "attr", ""))
                if name in _FUNNELS and len(node.args) > _FUNNELS[name]:
                    place = _FUNNELS[name]
                    told, more = node.args[place], node.args[place + 1 :]
                    kind = ast.unparse(more[0]) if more else "UserWarning"
                    yield told, self._texts(told), kind

    def _texts(self, node: ast.expr) -> list[str]:
        """What an expression may read, with gaps; nothing if another place tells."""
        match node:
            case ast.Constant(value=str(text)):
                return [text]
            case ast.JoinedStr(values=parts):
                return self._joined(parts)
            case ast.FormattedValue(value=ast.IfExp() as value):
                return self._texts(value)
            case ast.BinOp(op=ast.Add()):
                return self._joined([node.left, node.right])
            case ast.IfExp():
                return self._texts(node.body) + self._texts(node.orelse)
            case ast.Name(id=name):
                return self._assigned(node, name)
            case ast.Call(func=ast.Attribute(attr="format", value=template)):
                return [re.sub(r"\{\w*\}", GAP, text) for text in self._texts(template)]
            case ast.Call(func=ast.Name(id="str"), args=[ast.Attribute()]):
                return self._returned("__str__")[-1:]  # the first finds no fault
            case ast.Call(func=ast.Name(id=name)):
                return self._returned(name)
        return []

    def _joined(self, parts: list[ast.expr]) -> list[str]:
        choices = [self._texts(part) or [GAP] for part in parts]
        return ["".join(_choice(texts) for texts in choices)]

    def _assigned(self, node: ast.expr, name: str) -> list[str]:
        around = [
            function
            for function in self._functions
            if function.lineno <= node.lineno <= (function.end_lineno or 0)
        ]
        found: list[str] = []
        more: list[str] = []
        for inner in ast.walk(around[-1]) if around else ():  # the innermost
            match inner:
                case ast.Assign(targets=[ast.Name(id=target)]) if target == name:
                    found += self._texts(inner.value)
                case ast.AugAssign(target=ast.Name(id=target)) if target == name:
                    more += self._texts(inner.value)
        constant = self._known.get(name)
        if not found and isinstance(constant, ast.expr):
            found = self._texts(constant)
        return [text + _choice(more) for text in found] if more else found

    def _returned(self, name: str) -> list[str]:
        function = self._known.get(name)
        found = [
            node
            for node in (ast.walk(function) if function else ())
            if isinstance(node, ast.Return) and node.value is not None
        ]
        found.sort(key=lambda node: node.lineno)
        return [text for node in found for text in self._texts(node.value)]


def _choice(texts: list[str]) -> str:
    if len(texts) == 1:
        return texts[0]
    return f"⟨{' | '.join(text for text in dict.fromkeys(texts) if text)}⟩"


def _definitions(tree: ast.Module) -> dict[str, ast.AST]:
    """Functions and constants of a file by name."""
    found: dict[str, ast.AST] = {}
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name):
                found[name] = node
            case ast.Assign(targets=[ast.Name(id=name)]) if name.isupper():
                found[name] = node.value
    return found


@cache
def all_messages() -> tuple[list[Message], set[str]]:
    """Messages of the library, each once, and the expressions that hand others on."""
    files = {
        path: ast.parse(path.read_text(encoding="utf-8"))
        for path in sorted(ROOT.rglob("*.py"))
    }
    known: dict[str, ast.AST] = {}
    for tree in files.values():
        known |= _definitions(tree)
    found: dict[tuple[str, bool], Message] = {}
    relayed = set()
    for path, tree in files.items():
        module = _Module(path, tree, known)
        for expression, texts, kind in module.messages():
            texts = [text for text in texts if re.search(r"\w{3}", text)]
            if not texts:
                relayed.add(ast.unparse(expression))
            for text in texts:
                message = Message(text, kind, module.path)
                found.setdefault((text, message.is_warning), message)
    return list(found.values()), relayed


def pattern(text: str) -> re.Pattern[str]:
    """What matches the messages that a text of the page stands for."""
    parts = re.split(r"(…|⟨[^⟩]*⟩)", text)
    for k in range(1, len(parts), 2):
        options = parts[k][1:-1].split(" | ")
        inner = "|".join(pattern(option).pattern for option in options)
        parts[k] = ".*" if parts[k] == GAP else f"(?:{inner})*"
    parts[::2] = map(re.escape, parts[::2])
    return re.compile("".join(parts), re.DOTALL)


def write_page() -> None:
    """Write messages.rst, unless it is there already, as it should be."""
    text = page()
    target = Path(__file__).with_name("messages.rst")
    if not target.is_file() or target.read_text(encoding="utf-8") != text:
        target.write_text(text, encoding="utf-8")


def page() -> str:
    """The page in reStructuredText."""
    messages, _ = all_messages()
    lines = [_HEAD]
    for heading, of_warnings in (("Warnings", True), ("Errors", False)):
        lines += [heading, "-" * len(heading), ""]
        for title in _SECTIONS:
            own = [
                message
                for message in messages
                if message.is_warning == of_warnings and section_of(message) == title
            ]
            if own:
                lines += [title, "^" * len(title), "", ABOUT.get(title, ""), ""]
            for message in sorted(own, key=lambda m: m.text.strip("`… ").lower()):
                kind = _SPOKEN.get(message.kind, message.kind.split(".")[-1])
                remedy = remedy_of(message.text)
                lines += [escaped(message.text), f"   *{kind}*. {remedy}".rstrip(), ""]
    return "\n".join(lines)


def remedy_of(text: str) -> str:
    """What the page says beside a text; empty where the text says all."""
    return next((REMEDIES[key] for key in REMEDIES if text.startswith(key)), "")


def section_of(message: Message) -> str:
    """The title whose longest path begins that of the message."""
    fitting = {
        len(place): title
        for title, places in _SECTIONS.items()
        for place in places
        if message.path.startswith(place)
    }
    return fitting[max(fitting)]


def escaped(text: str) -> str:
    """A text as a term of a definition list; what it quotes as code."""
    text = " ".join(text.split())
    parts = re.split(r"(`[^`]+`)(?!\w)", text)
    parts[1::2] = [f"``{part[1:-1]}``" for part in parts[1::2]]
    parts[::2] = [re.sub(r"([\\*`_|:])", r"\\\1", part) for part in parts[::2]]
    term = "".join(parts)
    return term if term[0].isalpha() or term[0] == "`" else "\\" + term
