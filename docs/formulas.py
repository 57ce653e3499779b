"""Formulas written as plain text, typeset as MathML when the site is built: no script, nothing loaded, works offline.

What reads as mathematics is typeset, words between it stay words; whatever is not understood stays as it was written.
"""

from __future__ import annotations

import html
import re

__all__ = ["typeset"]

GREEK = {
    name: chr(code)
    for name, code in {
        "alpha": 0x3B1, "beta": 0x3B2, "gamma": 0x3B3, "delta": 0x3B4, "zeta": 0x3B6, "theta": 0x3B8, "lambda": 0x3BB,
        "mu": 0x3BC, "rho": 0x3C1, "sigma": 0x3C3, "tau": 0x3C4, "phi": 0x3C6, "psi": 0x3C8, "omega": 0x3C9,
    }.items()
}  # fmt: skip
MINUS, PRIME, DIFFERENCE = "\N{MINUS SIGN}", "\N{PRIME}", "\N{GREEK CAPITAL LETTER DELTA}"
FUNCTIONS = {"sin", "cos", "tan", "tanh", "exp", "log", "sqrt", "sgn", "clip", "max", "min", "sigmoid", "round", "step",
             "dz", "abs"}  # fmt: skip
NAMES = {"gain", "width", "limit", "gap", "offset", "step", "share", "load", "stop", "centre", "mgl", "upper", "lower"}
"""Longer names that are quantities; all other words of three letters and more are words."""
TOKEN = re.compile(
    r"(?P<unit>\b(?:rad|m)/s\b)|(?P<number>\d+(?:\.\d+)?)|(?P<raised>[A-Za-z]\w*\+(?=[ ,;)=]))"
    r"|(?P<name>[A-Za-z]\w*)|(?P<prime>'+)|(?P<sign><=|>=|!=|[-+*/^=<>()\[\]|,;:.])|(?P<space>\s+)|(?P<other>.)"
)
BRACKETED = "<mrow class='b'>"
RELATIONS = {"=": "=", "<": "&lt;", ">": "&gt;", "<=": "≤", ">=": "≥", "!=": "≠"}
CLOSING = {"(": ")", "[": "]"}


class _NoFormulaError(Exception):
    """What follows is no mathematics."""


class _Reader:
    """Reads formulas by precedence: relation, sum, product (also of factors side by side), quotient, power, atom."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = [
            (str(match.lastgroup), match.group(), match.start(), match.end())
            for match in TOKEN.finditer(text)
            if match.lastgroup != "space"
        ]
        self.at, self.bars, self.telling = 0, 0, False

    def peek(self) -> tuple[str, str]:
        return self.tokens[self.at][:2] if self.at < len(self.tokens) else ("end", "")

    def take(self) -> str:
        self.at += 1
        return self.tokens[self.at - 1][1]

    def relation(self) -> str:
        parts = [self.sum()]
        while self.peek()[1] in RELATIONS:
            before = self.at
            sign = RELATIONS[self.take()]
            try:
                parts += [f"<mo>{sign}</mo>", self.sum()]
            except _NoFormulaError:
                self.at = before
                break
            self.telling = True
        return "".join(parts)

    def sum(self) -> str:
        parts = []
        if self.peek()[1] in ("-", "+"):
            parts.append(f"<mo>{_minus(self.take())}</mo>")
            self.telling = True
        parts.append(self.product())
        while self.peek()[1] in ("-", "+"):
            before = self.at
            sign = _minus(self.take())
            try:
                parts += [f"<mo>{sign}</mo>", self.product()]
            except _NoFormulaError:
                self.at = before
                break
            self.telling = True
        return "".join(parts)

    def product(self) -> str:
        parts = [self.quotient()]
        while True:
            before = self.at
            if self.peek()[1] == "*":
                self.take()
            try:
                parts.append(self.quotient())
            except _NoFormulaError:
                self.at = before
                return "<mspace width='0.17em'/>".join(parts)

    def quotient(self) -> str:
        above = self.power()
        while self.peek()[1] == "/":
            self.take()
            above = f"<mfrac><mrow>{_bare(above)}</mrow><mrow>{_bare(self.power())}</mrow></mfrac>"
            self.telling = True
        return above

    def power(self) -> str:
        base = self.atom()
        if self.peek()[0] == "prime":
            marks, self.telling = len(self.take()), True
            base = f"<mrow>{base}<mo lspace='0' rspace='0'>{PRIME * marks}</mo></mrow>"
            if self.peek()[1] == "(" and self._touching():
                base += self.bracket()
        if self.peek()[1] == "^":
            self.take()
            base = f"<msup><mrow>{base}</mrow><mrow>{_bare(self.atom())}</mrow></msup>"
            self.telling = True
        return base

    def atom(self) -> str:
        kind, text = self.peek()
        if kind == "number":
            return f"<mn>{self.take()}</mn>"
        if kind == "raised":
            self.telling = True
            return f"<msup>{_name(self.take()[:-1])}<mo>+</mo></msup>"
        if kind == "name":
            return self.named(text)
        if text in CLOSING:
            return self.bracket()
        if text == "|" and not self.bars:
            before, self.bars = self.at, 1
            self.take()
            try:
                inside = self.sum()
            finally:
                self.bars = 0
            if self.peek()[1] != "|":
                self.at = before
                raise _NoFormulaError
            self.take()
            self.telling = True
            return f"<mrow><mo stretchy='false'>|</mo>{inside}<mo stretchy='false'>|</mo></mrow>"
        raise _NoFormulaError

    def named(self, text: str) -> str:
        follows = self.at + 1 < len(self.tokens) and self.tokens[self.at + 1][1] == "("
        touching = follows and self.tokens[self.at][3] == self.tokens[self.at + 1][2]
        if text in FUNCTIONS and (touching or text in ("sin", "cos", "tan", "exp", "log")):
            self.take()
            self.telling = True
            body = self.bracket() if touching else f"<mspace width='0.17em'/>{self.power()}"
            return f"<mrow><mi mathvariant='normal'>{text}</mi>{body}</mrow>"
        plain = re.match(r"[A-Za-z]+", text)
        assert plain is not None
        after_sign = self.at > 0 and self.tokens[self.at - 1][1] in _BEFORE_A  # else it is the article
        if text in _WORDS and not (text == "a" and after_sign):
            raise _NoFormulaError
        if text not in NAMES and text not in GREEK and len(plain.group()) > 2:
            raise _NoFormulaError
        self.take()
        return _name(text) + (self.bracket() if touching else "")

    def bracket(self) -> str:
        opening = self.take()
        parts = [self.relation()]
        while self.peek()[1] == ",":
            self.take()
            parts += ["<mo>,</mo>", self.relation()]
        if self.peek()[1] != CLOSING[opening]:
            raise _NoFormulaError
        self.take()
        return f"{BRACKETED}<mo>{opening}</mo>{''.join(parts)}<mo>{CLOSING[opening]}</mo></mrow>"

    def _touching(self) -> bool:
        return self.tokens[self.at - 1][3] == self.tokens[self.at][2]


_BEFORE_A = {*RELATIONS, "+", "-", "*", "/", "^", "(", "["}
_WORDS = {"a", "at", "an", "as", "by", "in", "is", "it", "no", "of", "on", "or", "to"}


def _minus(sign: str) -> str:
    return MINUS if sign == "-" else sign


def _bare(part: str) -> str:
    """Return a part of a fraction or an exponent without brackets around the whole of it."""
    found = re.fullmatch(r"<mrow class='b'><mo>\(</mo>(.*)<mo>\)</mo></mrow>", part)
    return found[1] if found and BRACKETED not in found[1] else part


def _name(text: str) -> str:
    """Return a quantity: Greek letters as such, what follows the first letter as an index."""
    if text in GREEK:
        return f"<mi>{GREEK[text]}</mi>"
    if text in NAMES:
        return f"<mi>{text}</mi>"
    if text[0] == "d" and len(text) == 2 and not text[1].isdigit():
        return (
            f"<mrow><mi>{DIFFERENCE}</mi><mi>{text[1]}</mi></mrow>"
            if text[1].isupper() or text == "dm"
            else f"<mi>{text}</mi>"
        )
    head, tail = text[0], text[1:].strip("_")
    return f"<msub><mi>{head}</mi><mi>{tail}</mi></msub>" if tail else f"<mi>{head}</mi>"


def typeset(text: str) -> str:
    """Return a law as HTML: what is mathematics as MathML, the words between as they are.

    Examples
    --------
    >>> typeset("F = -b v").count("<math"), f"<mo>{MINUS}</mo>" in typeset("F = -b v")
    (1, True)
    >>> typeset("gravity turned by hand")
    'gravity turned by hand'
    """
    reader, made, last = _Reader(text), [], 0
    while reader.at < len(reader.tokens):
        before, reader.telling = reader.at, False
        try:
            found = reader.relation()
        except (_NoFormulaError, IndexError):
            found, reader.bars = "", 0
        if not found or not reader.telling:
            reader.at = before + 1
            continue
        made.append(html.escape(text[last : reader.tokens[before][2]], quote=False))
        made.append(f'<span class="formula"><math>{found.replace(BRACKETED, "<mrow>")}</math></span>')
        last = reader.tokens[reader.at - 1][3]
    return "".join([*made, html.escape(text[last:], quote=False)])
