"""The facts of a data set: which files, how they are stored, what its classes are in ours, and what was published of it."""

import difflib
import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path

import jsonschema
import yaml

from streetscan.classes import LABELS, NAMES
from streetscan.errors import BadInput
from streetscan.io.foreign import Reader

PARTS = ("train", "validation", "test", "all")


@dataclass(frozen=True)
class Part:
    """One part of a data set.

    Attributes:
        files: relative to `data_root`, in the order of the map; none when the part is simulated or merged from a drive.
        n_tiles: number of groups the part is labelled in.
        stretch: from which to which share of the files' longer horizontal side the part reaches, the end left out unless it is 1.
    """

    files: tuple[str, ...]
    n_tiles: int
    stretch: tuple[float, float] = (0.0, 1.0)


@dataclass(frozen=True)
class Published:
    """What the publication says of a data set: one row of the thesis's Table 1.2 (inventory N-002).

    None is "not stated".
    """

    organisation: str | None = None
    sensor: str | None = None
    year: int | None = None
    annotation: str | None = None
    n_classes: int | None = None
    n_points: int | None = None
    fields: str | None = None
    licence: str | None = None
    citation: str | None = None


@dataclass(frozen=True)
class Dataset:
    """One place: its map in parts, and what is known of it.

    Attributes:
        name: as in file names and results.
        title: as in tables.
        source: `import`, `simulate` or `merge` (a registered drive).
        truth: `none`, `labels` or `poses`.
        parts: part name (`train`, `validation`, `test`; or `all` for a scan without truth) to part.
        crs: what pyproj reads (`EPSG:7415`), or None for a local frame or the files' own.
        reader: how the files are stored; None when simulated.
        class_map: foreign class id to the name of one of the nine classes, or `unlabelled`.
        groups: row title of a table to the classes it unites; empty when rows are classes.
        published: its row of Table 1.2.
    """

    name: str
    title: str
    source: str
    truth: str
    parts: dict[str, Part]
    crs: str | None = None
    reader: Reader | None = None
    class_map: dict[int, str] = field(default_factory=dict)
    groups: dict[str, tuple[str, ...]] = field(default_factory=dict)
    published: Published = Published()

    def part(self, name: str) -> Part:
        """A part by name. BadInput when the data set has none of that name."""
        if name not in self.parts:
            raise BadInput(f"data set '{self.name}'", f"has no part '{name}'", f"use one of {', '.join(self.parts)}")
        return self.parts[name]

    def files(self, part: str, data_root: str | Path) -> list[Path]:
        """Paths of a part's files. BadInput when the part or one of its files does not exist."""
        paths = [Path(data_root) / name for name in self.part(part).files]
        for path in paths:
            named = f"named in part '{part}' of data set '{self.name}'"
            if path.is_dir():
                raise BadInput(path, f"is a folder, {named}", "name the files in it")
            if not path.is_file():
                raise BadInput(path, f"no such file, {named}", "set data_root to where the data lie")
        return paths


def load_dataset(path: str | Path, schema_path: str | Path | None = None) -> Dataset:
    """Read and check a data set's file.

    Args:
        path: `config/datasets/<name>.yaml`.
        schema_path: the schema; None is `dataset.schema.yaml` in the folder above.
    Raises:
        BadInput: no such file, not YAML, a key twice, an unknown or missing key, a value of the wrong kind, an unknown
            class, or facts that contradict each other. The message names file and key.
    """
    path = Path(path)
    schema_path = Path(schema_path) if schema_path is not None else path.resolve().parent.parent / "dataset.schema.yaml"
    content = _read_yaml(path)
    if not isinstance(content, dict):
        raise BadInput(path, "holds no keys", "copy config/datasets/own_scan.yaml and fill it in")
    check_facts(content, _read_yaml(schema_path), path)
    if content["name"] != path.stem:
        raise BadInput(path, f"name is '{content['name']}'", f"set it to '{path.stem}', or rename the file")
    return parse_facts(content, path)


def parse_facts(facts: dict, where: object = "data set") -> Dataset:
    """The data set of facts that match the schema.

    Args:
        facts: the content of a data set's file.
        where: the file, named in errors.
    Raises:
        BadInput: an unknown class, or facts that contradict each other.
    """
    class_map = facts.get("class_map") or {}
    for class_id, name in class_map.items():
        if not isinstance(class_id, int) or isinstance(class_id, bool):
            raise BadInput(where, f"class_map has the id '{class_id}'", "give class ids as integers, without quotes")
        if name not in LABELS:
            raise BadInput(where, f"class_map.{class_id} is '{name}', which is no class", f"use one of {', '.join(LABELS)}")
    groups = facts.get("groups") or {}
    for title, names in groups.items():
        if unknown := [name for name in names if name not in NAMES]:
            raise BadInput(where, f"groups.{title} has '{unknown[0]}', which is no class", f"use some of {', '.join(NAMES)}")
    grouped = [name for names in groups.values() for name in names]
    if len(set(grouped)) < len(grouped):
        raise BadInput(where, "groups has a class twice", "put every class into one group")
    reader = facts.get("reader")
    if reader is not None:
        reader = Reader(**{k: tuple(v) if isinstance(v, list) else v for k, v in reader.items()})
    truth = facts["truth"]
    if facts["source"] == "import":
        if truth == "labels" and not reader.has_labels:
            raise BadInput(where, "truth is 'labels' but the reader has none", "set reader.label or reader.label_suffix, or truth: none")
        if truth == "labels" and not class_map:
            raise BadInput(where, "truth is 'labels' but class_map is empty", "give class_map an entry for every class id")
        if truth != "labels" and reader.has_labels:
            raise BadInput(where, f"truth is '{truth}' but the reader reads labels", "set truth: labels, or null the reader's labels")
    parts = {
        name: Part(tuple(part.get("files", ())), part["n_tiles"], tuple(part.get("stretch", Part.stretch)))
        for name, part in facts["parts"].items()
    }
    if "all" in parts and len(parts) > 1:
        raise BadInput(
            where, f"parts has 'all' beside '{next(p for p in parts if p != 'all')}'", "use 'all' alone, or train, validation, test"
        )
    for name, part in parts.items():
        if not part.stretch[0] < part.stretch[1]:
            raise BadInput(where, f"parts.{name}.stretch is {list(part.stretch)}", "give a lower and a higher share, such as [0, 0.7]")
        if repeated := [file for file in part.files if part.files.count(file) > 1]:
            raise BadInput(where, f"names '{repeated[0]}' twice", "name a file once in a part")
    for (a, first), (b, second) in itertools.combinations(parts.items(), 2):
        shared = set(first.files) & set(second.files)
        if shared and max(first.stretch[0], second.stretch[0]) < min(first.stretch[1], second.stretch[1]):
            raise BadInput(
                where, f"names '{min(shared)}' twice, in {a} and {b}", "put every file into one part, or give each a stretch of it"
            )
        if shared and set(first.files) != set(second.files):
            remedy = "name the same files in parts that share one, for a stretch is a share of all of them together"
            raise BadInput(where, f"{a} and {b} share '{min(shared)}' and no other files", remedy)
    return Dataset(
        name=facts["name"],
        title=facts["title"],
        source=facts["source"],
        truth=truth,
        parts=parts,
        crs=facts.get("crs"),
        reader=reader,
        class_map=class_map,
        groups={title: tuple(names) for title, names in groups.items()},
        published=Published(**facts.get("published") or {}),
    )


def check_facts(facts: dict, schema: dict, where: object) -> None:
    """BadInput in one sentence for the first way in which facts do not match their schema, or for a number that is none."""
    if place := _find_non_number(facts):
        raise BadInput(where, f"key '{place}' is infinite or not a number", "give a number")
    error = jsonschema.exceptions.best_match(jsonschema.Draft202012Validator(schema).iter_errors(facts))
    if error is None:
        return
    place = ".".join(str(step) for step in error.absolute_path)
    prefix = f"{place}." if place else ""
    if error.validator == "additionalProperties" and isinstance(error.instance, dict):
        known = list(error.schema.get("properties", ()))
        unknown = next(key for key in error.instance if key not in known)
        near = difflib.get_close_matches(str(unknown), known, 1)
        remedy = f"did you mean '{near[0]}'" if near else f"use one of {', '.join(known)}"
        raise BadInput(where, f"unknown key '{prefix}{unknown}'", remedy)
    if error.validator == "required":
        missing = next(key for key in error.validator_value if key not in error.instance)
        description = error.schema.get("properties", {}).get(missing, {}).get("description", "a template in config has it")
        raise BadInput(where, f"the key '{prefix}{missing}' is missing", f"add it ({description})")
    message = f"{error.instance} is not allowed" if error.validator == "not" else error.message
    message = message if len(message) < 200 else f"{message[:200]}..."
    description = error.schema.get("description")
    remedy = f"mend the value ({description})" if description else "mend the value"
    if error.validator == "type" and isinstance(error.instance, str) and "." in place:
        remedy += "; inside braces after --config every value is text, so write such values into a file"
    raise BadInput(where, f"key '{place}': {message}", remedy)


def _find_non_number(value: object) -> str:
    """Where in nested facts the first NaN or infinity stands, its keys joined by dots; empty when there is none."""
    if isinstance(value, float) and not math.isfinite(value):
        return "value"
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = ((key, _find_non_number(item)) for key, item in items)
    return next((f"{key}.{place}".removesuffix(".value") for key, place in found if place), "")


class _UniqueKeyLoader(yaml.SafeLoader):
    """PyYAML lets a later key overwrite an earlier one; a class id given twice is a mistake to report."""

    def construct_mapping(self, node, deep=False):
        seen = []
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' occurs twice", key_node.start_mark)
            seen.append(key)
        return super().construct_mapping(node, deep)


def _read_yaml(path: Path) -> object:
    if not path.is_file():
        raise BadInput(path, "no such file", "check its name and folder")
    try:
        return yaml.load(path.read_text(encoding="utf-8"), _UniqueKeyLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise BadInput(path, f"not readable as YAML{line}: {getattr(error, 'problem', None) or error}", "mend that line") from error
