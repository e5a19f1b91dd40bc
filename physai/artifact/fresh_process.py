"""A program that knows nothing of physai: runs a policy file on inputs, one by one, in a process of its own."""

import sys
import warnings


def main(policy: str, inputs: str, outputs: str) -> None:
    """Write what ``policy`` gives for each row of ``inputs`` (.npz), and distances, to ``outputs`` (.npy)."""
    for name in ("physai", "tensordict", "torchrl"):
        sys.modules[name] = None  # type: ignore[assignment]  # importing them fails from here on
    import numpy as np
    import torch

    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    module = torch.jit.load(policy)
    given = np.load(inputs)
    columns = [torch.from_numpy(given[key]) for key in given.files]  # joint_position, joint_velocity, goal, memory
    rows = []
    for index in range(len(columns[0])):
        row = [column[index : index + 1] for column in columns]
        answer = module(*row)
        answers = answer if isinstance(answer, tuple) else (answer,)
        rows.append(torch.cat([*answers, module.distance(row[0], row[2])], dim=1))
    np.save(outputs, torch.cat(rows).numpy())


if __name__ == "__main__":
    main(*sys.argv[1:])
