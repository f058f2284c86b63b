"""Write the compact ASTERIX tables of the package, one JSON file a category, from the definitions of libasterix.

    python scripts/asterix_tables.py src/saltus/asterix/tables

A file holds pools that its editions share (an item that did not change stands once):

    nodes   ["e", bits, content]              element; content: 0 raw, ["t", table], ["i", signed],
                                              ["q", signed, lsb, unit], ["s", "icao"|"ascii"|"octal"],
                                              ["b", 1 with its address behind it] Comm-B register,
                                              ["d", [field, ...], [[value, ...], content] ...] by another field
            ["g", [part, ...]]                group; a part is a number of spare bits or [name, title, node]
            ["x", [[part, ..., null], ...]]   extended item by its octets; null is the extension bit
            ["r", bytes, node]                repetition counted in so many bytes, 0 = chained by extension bits
            ["p", ""|"RE"|"SP"]               length and bytes
            ["c", bytes, [item, ...]]         compound of up to so many bytes of flags; null = spare
    items   [name, title, node]
    tables  {value: meaning}
    editions {edition: {"uaps": {name: [item, null, "RFS", ...]}, "bytes": {name: n},
                         "select": [[field, ...], {value: name}]}}
    expansions {edition: [bytes of flags, [item, ...]]}   what the reserved expansion field holds
"""

import json
import sys
from pathlib import Path
from typing import Any

from asterix import base, generated


class Pools:
    """Nodes, items and tables of one category, each once."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.items: list[Any] = []
        self.tables: list[Any] = []
        self._seen: dict[str, int] = {}

    def put(self, pool: list[Any], value: Any) -> int:
        """Index of a value in a pool."""
        key = f"{id(pool)} {json.dumps(value)}"
        if key not in self._seen:
            self._seen[key] = len(pool)
            pool.append(value)
        return self._seen[key]

    def item(self, non_spare: Any) -> int:
        """Index of an item."""
        return self.put(self.items, self.part(non_spare))

    def part(self, non_spare: Any) -> list[Any]:
        """Name, title and node of an item or a part of one."""
        return [non_spare.cv_name, non_spare.cv_title, self.node(variation(non_spare))]

    def node(self, v: Any) -> int:
        """Index of a node."""
        return self.put(self.nodes, self._node(v))

    def _node(self, v: Any) -> list[Any]:
        if issubclass(v, base.Element):
            return ["e", v.cv_bit_size, self._rule(v.cv_rule)]
        if issubclass(v, base.Group):
            return ["g", [self._entry(e) for e in v.cv_items_list]]
        if issubclass(v, base.Extended):
            return ["x", [[None if e is None else self._entry(e) for e in part] for part in v.cv_items_list]]
        if issubclass(v, base.Repetitive):
            return ["r", v.cv_rep_bytes or 0, self.node(v.cv_variation)]
        if issubclass(v, base.Explicit):
            return ["p", {base.ReservedExpansion: "RE", base.SpecialPurpose: "SP"}.get(v.cv_explicit_type, "")]
        return ["c", v.cv_fspec_max_bytes, [None if s is None else self.item(s) for s in v.cv_items_list]]

    def _entry(self, entry: Any) -> Any:
        spec, bits = entry
        return self.part(spec.cv_non_spare) if issubclass(spec, base.Item) else bits

    def _rule(self, rule: Any) -> Any:
        if issubclass(rule, base.RuleContentContextFree):
            return self._content(rule.cv_content)
        cases = [[list(values), self._content(content)] for values, content in rule.cv_cases]
        return ["d", ["/".join(path) for path in rule.cv_depends_on], *cases]

    def _content(self, c: Any) -> Any:
        if issubclass(c, base.ContentTable):
            return ["t", self.put(self.tables, {str(k): text for k, text in c.cv_values.items()})]
        if issubclass(c, base.ContentInteger):
            return ["i", int(c.cv_signedness is base.Signed)]
        if issubclass(c, base.ContentQuantity):
            return ["q", int(c.cv_signedness is base.Signed), c.cv_lsb, c.cv_unit]
        if issubclass(c, base.ContentString):
            kinds = {base.StringICAO: "icao", base.StringAscii: "ascii", base.StringOctal: "octal"}
            return ["s", kinds[c.cv_string_type]]
        if issubclass(c, base.ContentBds):
            return ["b", int(c.cv_bds_type is base.BdsWithAddress)]
        return 0


def variation(non_spare: Any) -> Any:
    """Definition of an item; where it depends on another item, the one that holds for all."""
    rule = non_spare.cv_rule
    return rule.cv_variation if hasattr(rule, "cv_variation") else rule.cv_default_variation


def edition(pools: Pools, uap: Any) -> dict[str, Any]:
    """The user application profiles of one edition."""
    single = issubclass(uap, base.UapSingle)
    records = {"": uap.cv_record} if single else uap.cv_uaps
    entries = {
        name: [
            pools.item(entry.cv_non_spare)
            if issubclass(entry, base.UapItem)
            else "RFS"
            if issubclass(entry, base.UapItemRFS)
            else None
            for entry in record.cv_items_list
        ]
        for name, record in records.items()
    }
    sizes = {name: record.cv_fspec_max_bytes for name, record in records.items()}
    found: dict[str, Any] = {"uaps": entries, "bytes": sizes}
    if not single:
        path, names = uap.cv_selector
        found["select"] = [list(path), {str(k): name for k, name in names.items()}]
    return found


def expansion(pools: Pools, definition: Any) -> list[Any]:
    """Contents of a reserved expansion field."""
    kind, size = definition.cv_type
    if kind is not base.FspecFixed:
        raise SystemExit("an expansion field with extensible flags: teach the tables about it")
    return [size, [None if s is None else pools.item(s) for s in definition.cv_items_list]]


def tables(category: int) -> dict[str, Any]:
    """All that is kept of one category."""
    pools = Pools()
    name = "{}.{}".format
    editions = {
        name(*e.cv_edition): edition(pools, e.cv_uap)
        for e in sorted(generated.manifest["CATS"][category], key=lambda e: e.cv_edition)
    }
    expansions = {
        name(*e.cv_edition): expansion(pools, e.cv_expansion)
        for e in sorted(generated.manifest["REFS"].get(category, []), key=lambda e: e.cv_edition)
    }
    return {
        "category": category,
        "editions": editions,
        "expansions": expansions,
        "items": pools.items,
        "nodes": pools.nodes,
        "tables": pools.tables,
    }


def lines(found: dict[str, Any]) -> str:
    """JSON with one entry of a pool a line: differences between editions of the library can be read."""
    compact = (",", ":")
    parts = [f'"category":{found["category"]}']
    for pool in ("editions", "expansions"):
        entries = [f"{json.dumps(k)}:{json.dumps(v, separators=compact)}" for k, v in found[pool].items()]
        parts.append(f'"{pool}":{{\n' + ",\n".join(entries) + "}")
    for pool in ("items", "nodes", "tables"):
        entries = [json.dumps(v, separators=compact, ensure_ascii=False) for v in found[pool]]
        parts.append(f'"{pool}":[\n' + ",\n".join(entries) + "]")
    return "{" + ",\n".join(parts) + "}\n"


def main() -> None:
    """Write one file for each category."""
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for category in generated.manifest["CATS"]:
        (folder / f"cat{category:03d}.json").write_text(lines(tables(category)), encoding="utf-8")


if __name__ == "__main__":
    main()
