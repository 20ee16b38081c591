from tests.benchmarks import kernels
import json,sys
for n in sys.argv[1:] or ("law","loop"): print(n, json.dumps(getattr(kernels,n)(),indent=1))
