"""Run as a script: simulates an FMU, whose native code can end or hang this process and no other.

    python fmu_child.py FMU FOLDER MODEL_IDENTIFIER GUID

Every call comes on standard input and is answered on standard output: a line of JSON, then 64-bit numbers in
the machine's byte order.

In: {"set": [...], "driven": [...], "seen": [...], "dt_s": s, "samples": T} with value references of the
parameters, inputs and outputs; then the parameters' values (as many as "set") and the inputs (T, U).
Out: {} and the outputs (T, Y), or {"error": one line} and nothing else.

What the FMU itself prints goes nowhere. FOLDER, where its files are unpacked, is removed here too: who asks
may have been killed.
"""

import json
import os
import shutil
import sys
from typing import Any


def main() -> None:
    """Answer calls until standard input ends. Ends with an exception where the FMU cannot be loaded."""
    import fmpy
    import numpy as np
    from fmpy.fmi2 import FMU2Slave

    path, folder, model_identifier, guid = sys.argv[1:]
    questions = sys.stdin.buffer
    answers = os.fdopen(os.dup(1), "wb")
    # Only a copy of standard output is left: native code writes to the descriptors themselves.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)

    def numbers(count: int) -> "np.ndarray[Any, np.dtype[np.float64]]":
        """(count,) the next numbers of the question."""
        return np.frombuffer(questions.read(8 * count), dtype=np.float64)

    try:
        fmpy.extract(path, folder)
        slave = FMU2Slave(
            guid=guid, unzipDirectory=folder, modelIdentifier=model_identifier, instanceName="flexlink"
        )
        slave.instantiate()
        while line := questions.readline():
            call = json.loads(line)
            values = numbers(len(call["set"]))
            inputs = numbers(call["samples"] * len(call["driven"])).reshape(call["samples"], -1)
            outputs = np.empty((len(inputs), len(call["seen"])))
            try:
                slave.reset()
                slave.setupExperiment(startTime=0.0)
                slave.setReal(call["set"], values.tolist())
                slave.enterInitializationMode()
                slave.exitInitializationMode()
                # Outputs are read at the instant at which the input changes, before the step.
                for row, held in enumerate(inputs):
                    slave.setReal(call["driven"], held.tolist())
                    outputs[row] = slave.getReal(call["seen"])
                    slave.doStep(row * call["dt_s"], call["dt_s"])
                answers.write(b"{}\n" + outputs.tobytes())
            except Exception as error:  # whatever fmpy makes of a status that is no success
                one_line = " ".join(str(error).split())
                answers.write(json.dumps({"error": one_line}).encode() + b"\n")
            answers.flush()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
