"""Find all possible mutants of a module: each is a small mistake of one of a few kinds.

This leaves out changes without an effect on correct programs: in annotations, docstrings, texts of
messages, code for type checkers, and code that only states what holds anyway (``assert``,
``strict=``, the bodies of abstract methods).
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

COPIES = {"duplicate", "deepcopy", "copy", "list", "dict", "set", "array"}
"""Functions that copy their first argument."""
CLEAN_UPS = {
    "cancel", "clear", "close", "discard", "join", "kill", "pop", "popitem", "release", "remove",
    "shutdown", "terminate", "unlink",
}  # fmt: skip
"""Methods that clean up."""
COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==",
    ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
SIMPLE = (
    ast.Assign,
    ast.AugAssign,
    ast.AnnAssign,
    ast.Expr,
    ast.Delete,
    ast.Raise,
    ast.Return,
    ast.Continue,
    ast.Break,
)


@dataclass(frozen=True)
class Mutant:
    """A change of a module's text.

    Attributes:
        module: Its path below the package.
        kind: The kind of mistake.
        at: The begin and the end of the replaced text, in bytes.
        instead: The new text.
        lines: The first and the last line of the statement (of its head, if it contains others).
        function: The first and the last line of the enclosing function.
    """

    module: str
    kind: str
    at: tuple[int, int]
    instead: str
    lines: tuple[int, int]
    function: tuple[int, int]

    @property
    def name(self) -> str:
        """A name that is unique for this source."""
        return (
            f"{self.module}:{self.lines[0]} {self.kind} {self.at[0]}-{self.at[1]}"
            f" {hash_of(self.instead)}"
        )

    def applied(self, text: str) -> str:
        """Return the text with the mistake."""
        data = text.encode()
        return (data[: self.at[0]] + self.instead.encode() + data[self.at[1] :]).decode()


def hash_of(text: str) -> str:
    """Return a short hash that is the same in every process."""
    return f"{sum(number * letter for number, letter in enumerate(text.encode(), 1)) % 46656:05d}"


def candidates(module: str, text: str) -> list[Mutant]:
    """List all possible mutants of a module."""
    found = {(mutant.at, mutant.instead): mutant for mutant in Drawer(module, text).all()}
    return [mutant for mutant in found.values() if compiles(mutant.applied(text))]


def compiles(text: str) -> bool:
    """Tell whether Python can compile a text."""
    try:
        compile(text, "mutant", "exec", dont_inherit=True)
    except SyntaxError:
        return False
    return True


class Drawer:
    """Walks the syntax tree of a module, and yields its mutants."""

    def __init__(self, module: str, text: str) -> None:
        self.module = module
        self.data = text.encode()
        self.tree = ast.parse(text)
        self.starts = [0]
        for line in self.data.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        """Return the begin and the end of a node, in bytes."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self.starts[node.lineno - 1] + node.col_offset, self.starts[
            node.end_lineno - 1
        ] + node.end_col_offset

    def source(self, node: ast.expr | ast.stmt) -> str:
        """Return the text of a node."""
        begin, end = self.span(node)
        return self.data[begin:end].decode()

    def all(self) -> Iterator[Mutant]:
        """Yield all mutants of all kinds."""
        yield from self.block(self.tree.body, (0, 0))

    def block(self, body: list[ast.stmt], function: tuple[int, int]) -> Iterator[Mutant]:
        """Yield the mutants of a block of statements."""
        for number, statement in enumerate(body):
            if not counts(statement):
                continue
            lines = statement.lineno, head(statement)
            if function != (0, 0) and isinstance(statement, SIMPLE):
                yield from self.of_statement(statement, body[number + 1 :], lines, function)
            for kind, at, instead in self.of_expressions(statement):
                yield Mutant(self.module, kind, at, instead, lines, function)
            within = function
            if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
                within = statement.lineno + 1, statement.end_lineno or statement.lineno
            for inner in blocks(statement):
                yield from self.block(inner, within)
            if isinstance(statement, ast.Try) and statement.finalbody:
                at = self.span(statement.finalbody[0])[0], self.span(statement.finalbody[-1])[1]
                final = statement.finalbody[0].lineno, statement.finalbody[-1].end_lineno or 0
                yield Mutant(self.module, "clean-up", at, "pass", final, within)

    def of_statement(
        self,
        statement: ast.stmt,
        rest: list[ast.stmt],
        lines: tuple[int, int],
        function: tuple[int, int],
    ) -> Iterator[Mutant]:
        """Yield the mutants of a whole statement: it is dropped, or swapped with the next one."""
        kind = "clean-up" if puts_away(statement) else "dropped"
        yield Mutant(self.module, kind, self.span(statement), "pass", lines, function)
        if rest and isinstance(rest[0], SIMPLE) and counts(rest[0]) and depend(statement, rest[0]):
            (begin, middle), (after, end) = self.span(statement), self.span(rest[0])
            swapped = (
                self.source(rest[0]) + self.data[middle:after].decode() + self.source(statement)
            )
            yield Mutant(
                self.module, "swapped", (begin, end), swapped, (lines[0], head(rest[0])), function
            )

    def of_expressions(self, statement: ast.stmt) -> Iterator[tuple[str, tuple[int, int], str]]:
        """Yield the mutants of a statement's own expressions, without its inner statements."""
        if isinstance(statement, ast.If | ast.While) and not isinstance(
            statement.test, ast.Constant
        ):
            yield "negated", self.span(statement.test), f"not ({self.source(statement.test)})"
        for node in expressions(statement):
            if isinstance(node, ast.IfExp):
                yield "negated", self.span(node.test), f"(not ({self.source(node.test)}))"
            elif isinstance(node, ast.ListComp | ast.SetComp | ast.GeneratorExp | ast.DictComp):
                for test in (test for generator in node.generators for test in generator.ifs):
                    yield "negated", self.span(test), f"(not ({self.source(test)}))"
            elif isinstance(node, ast.Call):
                if (
                    isinstance(node.func, ast.Attribute)
                    and node.func.attr == "copy"
                    and not node.args
                ):
                    yield "copy", self.span(node), self.source(node.func.value)
                elif node.args and copies(node.func):
                    yield "copy", self.span(node), f"({self.source(node.args[0])})"
            elif isinstance(node, ast.Compare) and len(node.ops) == 1:
                between = self.span(node.left)[1], self.span(node.comparators[0])[0]
                if (
                    b"(" not in self.data[slice(*between)]
                    and b")" not in self.data[slice(*between)]
                ):
                    yield "changed", between, f" {COMPARISONS[type(node.ops[0])]} "
            elif isinstance(node, ast.BoolOp):
                between = self.span(node.values[0])[1], self.span(node.values[1])[0]
                words = self.data[slice(*between)].decode()
                if words.strip() in ("and", "or"):
                    other = {"and": " or ", "or": " and "}[words.strip()]
                    yield "changed", between, other
            elif isinstance(node, ast.Constant) and isinstance(node.value, bool | int):
                value = node.value
                yield (
                    "changed",
                    self.span(node),
                    str((not value) if isinstance(value, bool) else value + 1),
                )


def head(statement: ast.stmt) -> int:
    """Return the last line of a statement's head: of the whole statement without inner ones."""
    inner = [block[0].lineno for block in blocks(statement) if block]
    return (
        max(statement.lineno, min(inner) - 1) if inner else statement.end_lineno or statement.lineno
    )


def counts(statement: ast.stmt) -> bool:
    """Tell whether a change of a statement can be a mistake.

    A change of names, types or texts alone cannot be one.
    """
    if isinstance(
        statement, ast.Import | ast.ImportFrom | ast.Global | ast.Nonlocal | ast.Pass | ast.Assert
    ):
        return False
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
        return False  # a docstring, or an ellipsis
    if isinstance(statement, ast.AnnAssign) and statement.value is None:
        return False
    text = ast.unparse(statement).partition("\n")[0]
    if text == "raise NotImplementedError":
        return False
    if isinstance(statement, ast.Assign) and text.startswith(("__all__", "__slots__")):
        return False
    if isinstance(statement, ast.If) and ("TYPE_CHECKING" in text or "__name__" in text):
        return False
    if isinstance(statement, ast.ClassDef):
        return not any("Protocol" in ast.unparse(base) for base in statement.bases)
    if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
        return not any(
            "overload" in ast.unparse(decorator) for decorator in statement.decorator_list
        )
    return True


def blocks(statement: ast.stmt) -> Iterator[list[ast.stmt]]:
    """Yield the blocks of statements in a statement."""
    for field in ("body", "orelse", "finalbody"):
        yield from filter(None, [getattr(statement, field, None)])
    for part in (*getattr(statement, "handlers", ()), *getattr(statement, "cases", ())):
        yield part.body


def expressions(statement: ast.stmt) -> Iterator[ast.expr]:
    """Yield a statement's own expressions, without annotations and messages."""
    waiting: list[ast.AST] = []
    for field, value in ast.iter_fields(statement):
        if field not in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            waiting += [
                item
                for item in (value if isinstance(value, list) else [value])
                if isinstance(item, ast.AST)
            ]
    while waiting:
        node = waiting.pop()
        if isinstance(
            node, ast.stmt | ast.JoinedStr | ast.arg | ast.ExceptHandler | ast.match_case
        ):
            continue
        if isinstance(node, ast.keyword) and node.arg == "strict":
            continue
        if isinstance(node, ast.expr):
            yield node
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in (
            "cast",
            "TypeVar",
            "ParamSpec",
        ):
            waiting += node.args[1:]
        else:
            waiting += ast.iter_child_nodes(node)


def puts_away(statement: ast.stmt) -> bool:
    """Tell whether a statement cleans up."""
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call):
        function = statement.value.func
        return isinstance(function, ast.Attribute) and function.attr in CLEAN_UPS
    return isinstance(statement, ast.Delete)


def copies(function: ast.expr) -> bool:
    """Tell whether a function copies its first argument."""
    name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
    return name in COPIES


def depend(one: ast.stmt, other: ast.stmt) -> bool:
    """Tell whether the order of two statements can matter."""
    if ast.dump(one) == ast.dump(other) or not isinstance(
        one, ast.Assign | ast.AugAssign | ast.Expr | ast.Delete
    ):
        return False  # code after a return is never reached
    lists = [appended_to(one), appended_to(other)]
    if None not in lists and lists[0] != lists[1]:
        return False
    calls = [
        any(isinstance(node, ast.Call | ast.Yield | ast.Await) for node in ast.walk(part))
        for part in (one, other)
    ]
    # a call for its side effects
    if all(calls) and (isinstance(one, ast.Expr) or isinstance(other, ast.Expr)):
        return True
    if isinstance(other, ast.Return | ast.Raise | ast.Continue | ast.Break):
        return True
    return any(changed_by(this) & names_in(that) for this, that in ((one, other), (other, one)))


def appended_to(statement: ast.stmt) -> str | None:
    """Return the list to which a statement appends, if it does nothing else."""
    call = statement.value if isinstance(statement, ast.Expr) else None
    if (
        not isinstance(call, ast.Call)
        or not isinstance(call.func, ast.Attribute)
        or call.func.attr != "append"
    ):
        return None
    alone = not any(
        isinstance(node, ast.Call) for argument in call.args for node in ast.walk(argument)
    )
    return ast.unparse(call.func.value) if alone else None


def changed_by(statement: ast.stmt) -> set[str]:
    """Return the targets of a statement's assignments, as source text."""
    inner = [node.target for node in ast.walk(statement) if isinstance(node, ast.comprehension)]
    own = {id(name) for target in inner for name in ast.walk(target)}  # local to the comprehension
    nodes = (
        node for node in ast.walk(statement) if isinstance(getattr(node, "ctx", None), ast.Store)
    )
    return {ast.unparse(node) for node in nodes if id(node) not in own}


def names_in(statement: ast.stmt) -> set[str]:
    """Return the names and attributes in a statement, as source text."""
    return {
        ast.unparse(node)
        for node in ast.walk(statement)
        if isinstance(node, ast.Name | ast.Attribute)
    }
