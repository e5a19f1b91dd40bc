"""A program that knows nothing of physai: runs a policy file on inputs, one by one, in a process of its own."""

import sys
import warnings


def main(policy: str, inputs: str, outputs: str) -> None:
    """Write what ``policy`` gives for each row of ``inputs`` (.npz), and errors, to ``outputs`` (.npz)."""
    for name in ("physai", "tensordict", "torchrl"):
        sys.modules[name] = None  # type: ignore[assignment]  # importing them fails from here on
    import numpy as np
    import torch

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    module = torch.jit.load(policy)
    given = np.load(inputs)
    columns = {key: torch.from_numpy(given[key]) for key in given.files}
    rows = []
    for index in range(len(given[given.files[0]])):
        row = {key: column[index : index + 1] for key, column in columns.items()}
        answer = module(**row)
        answers = answer if isinstance(answer, tuple) else (answer,)
        error = (module.error(row["joint_position"], row["goal"]),) if hasattr(module, "error") else ()
        rows.append((*answers, *error))
    np.savez(outputs, *(torch.cat(column).numpy() for column in zip(*rows)))  # noqa: B905


if __name__ == "__main__":
    main(*sys.argv[1:])
