"""Write the types of HEADER, which web pages read, from `PageHeader`: header.d.ts beside this file."""

from pathlib import Path

from msgspec import UNSET, inspect

from pansplat.export.page_data import PageHeader

_NAMES = {"IntType": "number", "FloatType": "number", "StrType": "string", "BoolType": "boolean", "NoneType": "null"}


def write_types() -> None:
    """Write an interface for each record."""
    found: dict[str, str] = {}

    def name(kind: inspect.Type) -> str:
        match kind:
            case inspect.StructType():
                fields = (
                    f"  {each.encode_name}{'?' * (each.default is UNSET)}: {name(each.type)};" for each in kind.fields
                )
                found.setdefault(kind.cls.__name__, "\n".join(fields))
                return kind.cls.__name__
            case inspect.VarTupleType():
                return f"Array<{name(kind.item_type)}>"
            case inspect.TupleType():
                names = [name(each) for each in kind.item_types]
                is_vector = len({*names}) == 1 and len(names) > 2  # the page's functions of vectors are those of arrays
                return f"Array<{names[0]}>" if is_vector else f"[{', '.join(names)}]"
            case inspect.UnionType():
                return " | ".join(name(each) for each in kind.types)
        return _NAMES[type(kind).__name__]

    header = name(inspect.type_info(PageHeader))
    interfaces = "".join(f"interface {each} {{\n{fields}\n}}\n\n" for each, fields in found.items())
    Path(__file__).with_name("header.d.ts").write_text(f"{interfaces}declare const HEADER: {header};\n", "utf-8")


if __name__ == "__main__":
    write_types()
