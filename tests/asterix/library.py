"""Random records made by libasterix, and what it says they hold: the oracle of the codec."""

import random

import numpy as np
from asterix import base, generated

from saltus.asterix.layout import SI


def definitions():
    """Yield (category, edition, profile, record class) of all that the library has."""
    for category, editions in generated.manifest["CATS"].items():
        for e in editions:
            edition = "{}.{}".format(*e.cv_edition)
            if issubclass(e.cv_uap, base.UapSingle):
                yield category, edition, "", e.cv_uap.cv_record
            else:
                for profile, record in e.cv_uap.cv_uaps.items():
                    yield category, edition, profile, record


def selector(category):
    """Path and values of the field that tells the profile of a record."""
    uap = generated.manifest["CATS"][category][-1].cv_uap
    return getattr(uap, "cv_selector", None)


class Draw:
    """Draws arguments for the library's `create`, and notes what each field is to hold."""

    def __init__(self, rng: random.Random, category: int) -> None:
        self.rng = rng
        self.category = category
        self.fields: dict[str, list[tuple[int, type]]] = {}
        self.forced: dict[str, int] = {}

    def record(self, record, profile):
        """Bytes of a random record."""
        told = selector(self.category)
        must = {"010"}
        if told:
            path, values = told
            must.add(path[0])
            self.forced["/".join(path)] = self.rng.choice([v for v, name in values.items() if name == profile])
        share = self.rng.choice([0.1, 0.5, 1.0])
        items = {}
        for entry in record.cv_items_list:
            if issubclass(entry, base.UapItem):
                name = entry.cv_non_spare.cv_name
                if name in must or self.rng.random() < share:
                    items[name] = self.variation(variation(entry.cv_non_spare), name, share)
        return record.create(items).unparse().to_bytes()

    def variation(self, v, path, share):
        """An argument for one variation."""
        if issubclass(v, base.Element):
            return self.element(v, path)
        if issubclass(v, base.Group):
            return self.group(v, path)
        if issubclass(v, base.Extended):
            named = [any(e and issubclass(e[0], base.Item) for e in part) for part in v.cv_items_list]
            n = self.rng.choice(
                [k + 1 for k, holds in enumerate(named) if holds]
            )  # a last part of spare bits says nothing
            return tuple(tuple(self.part(e, path) for e in part) for part in v.cv_items_list[:n])
        if issubclass(v, base.Repetitive):
            n = self.rng.randint(1, 4)
            return [self.variation(v.cv_variation, path, share) for _ in range(n)]
        if issubclass(v, base.Explicit):
            return self.explicit(v, path, share)
        names = [s for s in v.cv_items_list if s is not None]
        sent = [s for s in names if self.rng.random() < share] or [self.rng.choice(names)]
        return {s.cv_name: self.variation(variation(s), f"{path}/{s.cv_name}", share) for s in sent}

    def element(self, v, path):
        rule = v.cv_rule
        content = rule.cv_content if issubclass(rule, base.RuleContentContextFree) else rule.cv_default_content
        raw = self.forced.get(path, self.rng.getrandbits(v.cv_bit_size))
        self.fields.setdefault(path, []).append((raw, v.cv_bit_size, content))
        return raw

    def group(self, v, path):
        return tuple(self.part(e, path) for e in v.cv_items_list)

    def part(self, entry, path):
        if entry is None:
            return None
        spec, _ = entry
        if issubclass(spec, base.Spare):
            return 0
        return self.variation(variation(spec.cv_non_spare), f"{path}/{spec.cv_non_spare.cv_name}", 1.0)

    def explicit(self, v, path, share):
        references = generated.manifest["REFS"].get(self.category)
        if v.cv_explicit_type is base.ReservedExpansion and references:
            newest = max(references, key=lambda e: e.cv_edition).cv_expansion
            for _ in range(100):
                names = [s for s in newest.cv_items_list if s is not None]
                drawn = Draw(self.rng, self.category)
                held = {
                    s.cv_name: drawn.variation(variation(s), f"{path}/{s.cv_name}", share)
                    for s in names
                    if self.rng.random() < 0.4
                }
                octets = newest.create(dict(held)).unparse().to_bytes()
                if held and len(octets) < 255:
                    self.fields |= drawn.fields
                    return octets
        return self.rng.randbytes(self.rng.randint(1, 20))


def variation(non_spare):
    rule = non_spare.cv_rule
    return rule.cv_variation if hasattr(rule, "cv_variation") else rule.cv_default_variation


def value(raw, size, content):
    """What the library makes of a raw value; quantities in SI units."""
    if issubclass(content, base.ContentQuantity):
        number = content.cv_signedness.convert(size, raw) * content.cv_lsb
        return number * SI.get(content.cv_unit, 1.0)
    if issubclass(content, base.ContentInteger):
        return content.cv_signedness.convert(size, raw)
    if issubclass(content, base.ContentString) and content.cv_string_type is not base.StringOctal:
        text = content.cv_string_type.to_string(size, raw)
        return text.replace("\0", "").strip(" ").encode("latin-1")
    return raw


def in_blocks(category, octets):
    """Records in data blocks of up to three: the bytes, where each block starts, and its length."""
    data, offset, length = b"", [], []
    for k in range(0, len(octets), 3):
        body = b"".join(octets[k : k + 3])
        offset.append(len(data))
        data += bytes([category]) + (len(body) + 3).to_bytes(2, "big") + body
        length.append(len(body) + 3)
    return data, np.array(offset), np.array(length)


def parsed(record, data):
    """What the library makes of bytes as a record: its length in bytes and its fields, or None where it refuses."""
    try:
        result = record.parse(base.ParsingMode.StrictParsing, base.Bits.from_bytes(data))
    except TypeError:  # a field specification longer than the items there are
        return None
    if isinstance(result, ValueError):
        return None
    found, rest = result
    fields = {}
    for name, item in found.items_regular.items():
        _flatten(item, name, fields)
    for some in found.items_rfs:
        for name, item in some or ():
            _flatten(item, name, fields)
    return len(data) - len(rest) // 8, fields


def _flatten(non_spare, path, fields):
    rule = non_spare.arg
    if isinstance(rule, base.RuleVariationDependent):
        obj, _ = rule.cv_default_variation._parse(rule.bs)
    else:
        obj = rule.arg
    _values(obj, path, fields)


def _values(obj, path, fields):
    if isinstance(obj, base.Element):
        rule = obj.cv_rule
        content = rule.cv_content if issubclass(rule, base.RuleContentContextFree) else rule.cv_default_content
        fields.setdefault(path, []).append((obj.bs.to_uinteger(), obj.cv_bit_size, content))
    elif isinstance(obj, base.Repetitive):
        for one in obj.arg:
            _values(one, path, fields)
    elif isinstance(obj, base.Compound):
        for name, item in obj.arg.items():
            _flatten(item, f"{path}/{name}", fields)
    elif isinstance(obj, base.Group | base.Extended):
        parts = obj.arg if isinstance(obj, base.Group) else [item for part in obj.arg for item in part]
        for item in parts:
            if isinstance(item, base.Item):
                _flatten(item.arg, f"{path}/{item.arg.cv_name}", fields)
