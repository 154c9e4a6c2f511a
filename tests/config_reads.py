"""Which config keys a source reads: an attribute of something that is known to be a config section.

What a name holds follows from annotations (of arguments, attributes and functions' results) and from assignments; a
key that is read through a name of unknown kind does not count, so that ``self.steps`` is no reading of
``trainer.steps``.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass

Kinds = frozenset[str]
NOTHING: Kinds = frozenset()
Read = tuple[str, str]  # section's class, key


def keys_of(schema: type) -> Iterator[Read]:
    """Every key of a config class and of its sections, as ``(class name, key)``; sections themselves excluded."""
    import gran_bench.config as schemas

    for entry in fields(schema):
        sections = [
            section
            for name in _words(ast.parse(str(entry.type), mode="eval"))
            if is_dataclass(section := getattr(schemas, name, None))
        ]
        for section in sections:
            yield from keys_of(section)
        if not sections:
            yield schema.__name__, entry.name


def reads(sources: Iterable[str], schemas: Iterable[type]) -> set[Read]:
    """The keys that Python sources read.

    Args:
        sources: texts of modules that see each other's classes.
        schemas: the config classes.
    """
    trees = [ast.parse(source) for source in sources]
    reader = _Reader()
    for schema in schemas:
        for entry in fields(schema):
            reader.attributes[schema.__name__][entry.name] = _words(ast.parse(str(entry.type), mode="eval"))
    # Attributes and results become known while reading, so it is read until no more is learnt.
    known = -1
    while known != (known := reader.known):
        for tree in trees:
            reader.block(tree.body, {}, None)
    return reader.found


def _words(annotation: ast.AST | None) -> Kinds:
    """Class names in an annotation."""
    if annotation is None:
        return NOTHING
    return frozenset(node.id for node in ast.walk(annotation) if isinstance(node, ast.Name))


class _Reader:
    """Walks over modules; ``attributes[class][name]`` and ``results[function]`` are the kinds that they hold."""

    def __init__(self) -> None:
        self.attributes: dict[str, dict[str, Kinds]] = defaultdict(dict)
        self.results: dict[str, Kinds] = {}
        self.found: set[Read] = set()

    @property
    def known(self) -> int:
        """How much is known."""
        return len(self.found) + len(self.results) + sum(map(len, self.attributes.values()))

    def block(self, body: list[ast.stmt], names: dict[str, Kinds], owner: str | None) -> None:
        """Read statements in order; ``names`` are those in sight, ``owner`` is the class that they stand in."""
        for node in body:
            self.statement(node, names, owner)

    def statement(self, node: ast.stmt, names: dict[str, Kinds], owner: str | None) -> None:
        """Read one statement and what is below it."""
        if isinstance(node, ast.ClassDef):
            self.block(node.body, dict(names), node.name)
        elif isinstance(node, ast.FunctionDef):
            self.function(node, names, owner)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names[node.target.id] = _words(node.annotation)
            if owner is not None:
                self.attributes[owner][node.target.id] = _words(node.annotation)
            self.expressions(node, names)
        elif isinstance(node, ast.Assign):
            self.expressions(node, names)
            self.assign(node.targets[0], node.value, names)
        else:
            self.expressions(node, names)
            for part in ("body", "orelse", "finalbody"):
                self.block(getattr(node, part, []), names, owner)
            for handler in getattr(node, "handlers", []):
                self.block(handler.body, names, owner)

    def function(self, node: ast.FunctionDef, outer: dict[str, Kinds], owner: str | None) -> None:
        """Read a function with its arguments in sight."""
        names = dict(outer)
        for argument in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]:
            names[argument.arg] = _words(argument.annotation)
        if owner is not None and node.args.args and node.args.args[0].arg == "self":
            names["self"] = frozenset({owner})
            if any(_words(decorator) & {"property"} for decorator in node.decorator_list):
                self.attributes[owner][node.name] = _words(node.returns)
        self.results.setdefault(node.name, _words(node.returns))
        self.block(node.body, names, None)

    def assign(self, target: ast.expr, value: ast.expr, names: dict[str, Kinds]) -> None:
        """Remember what a name or an attribute of self holds from now on."""
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for one, other in zip(target.elts, value.elts, strict=True):
                self.assign(one, other, names)
        elif isinstance(target, ast.Name):
            names[target.id] = self.kinds(value, names)
        elif isinstance(target, ast.Attribute):
            for owner in self.kinds(target.value, names):
                if kinds := self.kinds(value, names):
                    self.attributes[owner][target.attr] = kinds

    def expressions(self, node: ast.stmt, names: dict[str, Kinds]) -> None:
        """Find the keys that a statement's own expressions read."""
        for part in ast.iter_child_nodes(node):
            if isinstance(part, ast.stmt | ast.ExceptHandler):
                continue
            for inner in ast.walk(part):
                if isinstance(inner, ast.Attribute) and isinstance(inner.ctx, ast.Load):
                    self.found |= {(kind, inner.attr) for kind in self.kinds(inner.value, names)}
                elif isinstance(inner, ast.Call) and getattr(inner.func, "id", "") == "getattr":
                    self.found |= self.by_name(inner, names)

    def by_name(self, call: ast.Call, names: dict[str, Kinds]) -> set[Read]:
        """``getattr(section, name)`` with a name from somewhere reads every key of the section."""
        return {(kind, key) for kind in self.kinds(call.args[0], names) for key in self.attributes.get(kind, {})}

    def kinds(self, value: ast.expr, names: dict[str, Kinds]) -> Kinds:
        """The classes that an expression may be of."""
        if isinstance(value, ast.Name):
            return names.get(value.id, NOTHING)
        if isinstance(value, ast.Attribute):
            owners = self.kinds(value.value, names)
            return frozenset().union(*(self.attributes.get(owner, {}).get(value.attr, NOTHING) for owner in owners))
        if isinstance(value, ast.BoolOp):
            return frozenset().union(*(self.kinds(part, names) for part in value.values))
        if isinstance(value, ast.IfExp):
            return self.kinds(value.body, names) | self.kinds(value.orelse, names)
        if isinstance(value, ast.Call):
            name = getattr(value.func, "id", getattr(value.func, "attr", ""))
            return self.results.get(name, frozenset({name}))
        return NOTHING
