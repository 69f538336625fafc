"""Machine code as printed by Dr.Jit: instructions of a kernel, loops, and kinds of instructions."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

# The first pattern that matches the start of a mnemonic determines its kind.
_KINDS = (
    ("multiply-add", r"vfn?m(add|sub)"),
    ("divide", r"v(div|sqrt|rcp|rsqrt)"),
    ("multiply", r"vmul"),
    ("add", r"v(add|sub)[ps]"),
    ("minimum, maximum", r"v(min|max)"),
    ("compare", r"v(cmp|pcmp|ptest|ucomi)"),
    ("gather", r"v(p?gather|pscatter|scatter)"),
    ("shuffle", r"v(unpck|punpck|shuf|pshuf|perm|insert|pinsert|extract|pextr|p?broadcast|pmovsx|pmovzx|movh|movl)"),
    ("mask", r"k"),
    ("branch", r"(j|call|ret)"),
    ("integer", r"(v?p|vx?or|vand|test|cmp|add|sub|and|or|xor|sh|imul|inc|dec|lea|neg|not|set|bt|tzcnt|popcnt)"),
    ("move", r"v?mov"),
)


@dataclass(frozen=True)
class Instruction:
    """One line of a listing: address, mnemonic and operands."""

    address: int
    name: str
    operands: str

    @property
    def jump(self) -> int | None:
        """Distance of a direct jump from the next instruction; None for other instructions."""
        return int(self.operands) if self.name.startswith("j") and re.fullmatch(r"-?\d+", self.operands) else None


def kernel_code(log: str, label: str) -> list[Instruction]:
    """Return the instructions of the last kernel whose IR has a loop with this label."""
    start = log.rfind(f"; Symbolic loop: {label}\n")
    start = log.find("jit_llvm_disasm(): =====", start) if start >= 0 else -1
    line = re.compile(r"jit_llvm_disasm\(\): 0x([0-9a-f]+)\s+(\S+)[ \t]*(.*)")
    found = []
    for text in log[start:].splitlines()[1:] if start >= 0 else ():
        if match := line.match(text):
            if match[2] != "nop":  # padding, never executed
                found.append(Instruction(int(match[1], 16), match[2], match[3]))
        elif not text.startswith("jit_llvm_disasm(): ..."):
            break
    if not found:
        raise SystemExit(f"kernel_code(): Dr.Jit {version('drjit')} printed no machine code for {label!r}.")
    return found


def successors(code: list[Instruction]) -> list[list[int]]:
    """Return the indices of the possible successors of each instruction."""
    index = {instruction.address: k for k, instruction in enumerate(code)}
    result = []
    for k, instruction in enumerate(code):
        follows = [k + 1] if k + 1 < len(code) and not re.match(r"(jmp|ret)", instruction.name) else []
        if instruction.jump is not None:
            # Padding is skipped, so the size of a jump is determined from its distance and not from the next line.
            short = -128 <= instruction.jump <= 127
            size = 2 if short else 5 if instruction.name == "jmp" else 6
            target = index.get(instruction.address + size + instruction.jump)
            if target is not None:
                follows.append(target)
        result.append(follows)
    return result


def cycles(nodes: set[int], follows: list[list[int]]) -> list[set[int]]:
    """Return the strongly connected components with more than one node among `nodes` (Kosaraju)."""
    order: list[int] = []
    seen: set[int] = set()
    for root in nodes:
        stack: list[tuple[int, Iterator[int]]] = [] if root in seen else [(root, iter(follows[root]))]
        seen.add(root)
        while stack:
            node, rest = stack[-1]
            child = next((c for c in rest if c in nodes and c not in seen), None)
            if child is None:
                order.append(stack.pop()[0])
            else:
                seen.add(child)
                stack.append((child, iter(follows[child])))
    before: dict[int, list[int]] = {node: [] for node in nodes}
    for node in nodes:
        for child in follows[node]:
            if child in nodes:
                before[child].append(node)
    components, remaining = [], set(nodes)
    for root in reversed(order):
        component, todo = set(), [root]
        while todo:
            node = todo.pop()
            if node in remaining:
                remaining.remove(node)
                component.add(node)
                todo += before[node]
        if len(component) > 1:
            components.append(component)
    return components


def inner_loops(loop: set[int], follows: list[list[int]]) -> list[set[int]]:
    """Return the loops inside a loop: the cycles that remain without its entry."""
    entries = {child for k, children in enumerate(follows) if k not in loop for child in children if child in loop}
    return cycles(loop - (entries or {min(loop)}), follows)


def main_loop(code: list[Instruction]) -> tuple[list[Instruction], list[Instruction]]:
    """Return the body of the longest loop inside the loop over packets, and the instructions of its inner loops."""
    follows = successors(code)
    packets = max(cycles(set(range(len(code))), follows), key=len)
    loop = max(inner_loops(packets, follows), key=len)
    inner = set().union(*inner_loops(loop, follows))
    return [code[k] for k in sorted(loop - inner)], [code[k] for k in sorted(inner)]


def kind(instruction: Instruction) -> str:
    """Return the kind of an instruction; moves are classified by their operands as load, store or move."""
    if instruction.name.startswith("vpmulld"):
        return "integer"
    if instruction.name in ("vmovq", "vmovd") and "[" not in instruction.operands:
        return "shuffle"
    found = next((name for name, pattern in _KINDS if re.match(pattern, instruction.name)), "other")
    if found not in ("move", "mask", "shuffle") or "[" not in instruction.operands:
        return found
    if "[" in instruction.operands.split(",")[0]:
        return "store"
    return "load" if found != "shuffle" or "broadcast" in instruction.name else found


def counts(code: list[Instruction]) -> dict[str, Any]:
    """Return the number of instructions by kind, and of memory accesses by location."""
    memory = Counter()
    for instruction in code:
        if "[" in instruction.operands and instruction.name != "lea":
            locations = {"rsp": "stack", "rip": "constant"}
            location = next((name for register, name in locations.items() if register in instruction.operands), "data")
            memory[f"{location} {'stores' if kind(instruction) == 'store' else 'loads'}"] += 1
    kinds = Counter(map(kind, code))
    return {"total": len(code), "kinds": dict(kinds.most_common()), "memory": dict(memory.most_common())}
