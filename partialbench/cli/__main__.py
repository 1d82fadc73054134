from partialbench.cli import main

main()
