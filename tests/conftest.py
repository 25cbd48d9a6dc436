import torch

# Many small networks: threads would only wait for each other.
torch.set_num_threads(1)
