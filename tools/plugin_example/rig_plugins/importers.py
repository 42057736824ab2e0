"""Importer of `.bench` files, an invented format of a test bench.

Its first line is `BENCH 1`, the second one names the columns with their units, and the others hold the
values with decimal commas:

    BENCH 1
    t [ms];valve [%];stroke [mm];pA [bar];pB [bar];pP [bar]
    0;0,0;100,0;20,1;33,0;140,0
"""

import numpy as np

import hydrotele as ht


def read_bench(path):
    """Return the columns of a `.bench` file as a recording."""
    lines = path.read_text(encoding="utf-8").splitlines()
    if not lines or lines[0].strip() != "BENCH 1":
        raise ht.InputError(f"{path}:1", "is not a bench file: the first line must be 'BENCH 1'")
    heads = [head.strip().rstrip("]").split(" [") for head in lines[1].split(";")]
    rows = []
    for number, line in enumerate(lines[2:], 3):
        try:
            rows.append([float(value.replace(",", ".")) for value in line.split(";")])
        except ValueError as error:
            raise ht.InputError(f"{path}:{number}", str(error)) from None
        if len(rows[-1]) != len(heads):
            raise ht.InputError(f"{path}:{number}", f"has {len(rows[-1])} values for {len(heads)} columns")
    values = np.array(rows).T
    columns = {name: column for (name, _), column in zip(heads[1:], values[1:], strict=True)}
    return ht.make_recording(path, values[0] / 1000.0, columns, {name: unit for name, unit in heads[1:]})


BENCH = ht.Importer(suffixes=(".bench",), read=read_bench)
