"""Run as a script: simulates an FMU, whose native code can end or hang this process and no other.

    python fmu_child.py FMU FOLDER MODEL_IDENTIFIER GUID

Every call comes on standard input and is answered on standard output: a line of JSON, then 64-bit numbers.
In: {"set": [value references], "driven": [...], "seen": [...], "dt_s": s, "samples": T}, the values to set,
and inputs (T, U). Out: {} and outputs (T, Y), or {"error": one line}. What the FMU itself prints goes
nowhere. FOLDER, where its files are unpacked, is removed here too: who asks may have been killed.
"""

import json
import os
import shutil
import sys


def main() -> None:
    import fmpy
    import numpy as np
    from fmpy.fmi2 import FMU2Slave

    path, folder, identifier, guid = sys.argv[1:]
    answers, nowhere = os.fdopen(os.dup(1), "wb"), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    asked = sys.stdin.buffer

    def numbers(count: int) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
        return np.frombuffer(asked.read(8 * count), dtype=np.float64)

    try:
        fmpy.extract(path, folder)
        slave = FMU2Slave(
            guid=guid, unzipDirectory=folder, modelIdentifier=identifier, instanceName="flexlink"
        )
        slave.instantiate()
        while line := asked.readline():
            call = json.loads(line)
            values = numbers(len(call["set"]))
            inputs = numbers(call["samples"] * len(call["driven"])).reshape(call["samples"], -1)
            found = np.empty((len(inputs), len(call["seen"])))
            try:
                slave.reset()
                slave.setupExperiment(startTime=0.0)
                slave.setReal(call["set"], values.tolist())
                slave.enterInitializationMode()
                slave.exitInitializationMode()
                for k, row in enumerate(inputs):
                    slave.setReal(call["driven"], row.tolist())
                    found[k] = slave.getReal(call["seen"])
                    slave.doStep(k * call["dt_s"], call["dt_s"])
                answers.write(b"{}\n" + found.tobytes())
            except Exception as error:  # whatever fmpy makes of a status that is no success
                answers.write(json.dumps({"error": " ".join(str(error).split())}).encode() + b"\n")
            answers.flush()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
