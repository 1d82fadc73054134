"""How real the parametric families are, measured against aligned ModelNet40 clouds.

    python -m benchmarks.realism occupancy --real FILE.h5 --out DIR
    python -m benchmarks.realism classify  --real FILE.h5 --cache DIR [--reverse] [--final]

FILE.h5 holds complete aligned clouds as ``clouds.real`` reads them. Families are tuned on the train
split alone; ``--final`` reads the test split and writes the confusion matrix. Pictures drawn by
``occupancy`` show licensed data: look at them, never publish them.
"""
