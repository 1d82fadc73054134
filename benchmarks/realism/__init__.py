"""How real the parametric families are, measured against aligned ModelNet40 clouds.

    python -m benchmarks.realism occupancy --real FILE.h5 --cache DIR --out DIR
    python -m benchmarks.realism classify  --real FILE.h5 --cache DIR --train parametric --test real
    python -m benchmarks.realism classify  --real FILE.h5 --cache DIR --train real --test parametric

FILE.h5 holds complete aligned clouds as ``clouds.real`` reads them. Families are tuned on its train
split alone; ``classify --final --out CSV`` reads the test split and writes the confusion matrix.
``occupancy`` draws licensed data: look at the pictures, never publish them.
"""
