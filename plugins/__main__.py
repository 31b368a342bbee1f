import sys

from rimlight.cli import main

sys.exit(main())
