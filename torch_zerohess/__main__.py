"""`python -m torch_zerohess` prints what works on this machine."""

from torch_zerohess.doctor import doctor

if __name__ == "__main__":
    print(doctor())
